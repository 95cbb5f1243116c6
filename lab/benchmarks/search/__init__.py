"""Search latency against exact rivals; every result is compared with brute force in float64.

    placewise bench search [--photos 2000] [--dimensions 512,7168,98304] [--growth]

A generated map of VLAD-like descriptors (`synthetic_map`) is searched by Placewise, NumPy, faiss
and by loading every chunk (`methods`, `comparison`). Columns: p50 and p95 of a query; p50 divided
by that of Placewise; queries with a wrong result. `cold_cache` drops the rows from the page cache,
`growth` scans the codes of up to a million photos.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from lab.benchmarks.report import parse_integers, printed_report
from lab.benchmarks.search.cold_cache import measure_cold_cache
from lab.benchmarks.search.comparison import compare_methods, report_comparison
from lab.benchmarks.search.growth import measure_growth
from lab.benchmarks.search.synthetic_map import (
    CHUNK_ROWS,
    SyntheticCity,
    create_synthetic_map,
    required_memory_bytes,
)
from services.cli.output import JsonOption

SEED = 20_261_121


def bench(
    photos: Annotated[
        Any,
        typer.Option(
            help="Numbers of photos in the map, comma-separated.",
            parser=parse_integers,
            metavar="INTEGERS",
        ),
    ] = "2000",
    dimensions: Annotated[
        Any,
        typer.Option(
            help="Descriptor dimensions, multiples of 64, comma-separated.",
            parser=parse_integers,
            metavar="INTEGERS",
        ),
    ] = "512,7168,98304",
    queries: Annotated[int, typer.Option(min=2, help="Queries of each kind.")] = 20,
    growth: Annotated[
        bool, typer.Option("--growth", help="Also scan the sign codes of up to a million photos.")
    ] = False,
    folder: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            file_okay=False,
            help="Folder for the map, on a real disk: 600 kB per photo of 98,304 dimensions.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare search latency with NumPy, faiss and full chunk reads, and check the results."""
    with printed_report("Search", as_json) as (report, progress):
        report.details["comparisons"] = []
        for dimension in sorted(dimensions, reverse=True):
            city = SyntheticCity(dimension, SEED)
            for count in photos:
                with tempfile.TemporaryDirectory(dir=folder, prefix="placewise-bench-") as home:
                    making = progress.add_task(f"{count:,} x {dimension:,}", total=count)
                    with create_synthetic_map(
                        Path(home, "home"),
                        dimension,
                        search_memory_budget=required_memory_bytes(count, dimension),
                    ) as world:
                        for rows in city.chunks(count, CHUNK_ROWS):
                            world.add(rows)
                            progress.advance(making, len(rows))
                        compared = compare_methods(world, city, queries, progress)
                        report.tables.append(compared.table())
                        report.details["comparisons"].append(compared.as_json())
                        report_comparison(report, compared)
                        if (count, dimension) == (max(photos), max(dimensions)):
                            measure_cold_cache(report, world, city, queries, progress)
        if growth:
            measure_growth(report, progress)
