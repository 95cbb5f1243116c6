"""Search latency against baselines; every result is compared with brute force in float64.

    placewise bench search [--photos 2000] [--dimensions 512,7168,98304] [--growth] [--load SECONDS]

A generated map of VLAD-like descriptors (`synthetic_map`) is searched by Placewise, NumPy, faiss
and by reading every chunk (`methods`, `comparison`). Columns: p50 and p95 of a query; p50 divided
by that of Placewise; size of the index in memory; bytes of codes and rows that a query reads; p50
divided by the time in which this machine reads as many bytes; queries, and those with a wrong
result. `cold_cache` drops the rows from the page cache, `growth` scans the codes of up to a million
photos, `load` runs 32 clients while the map changes; `memory_traffic` measures bandwidth.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lab.benchmarks.report import Report
from lab.benchmarks.search.cold_cache import measure_cold_cache
from lab.benchmarks.search.comparison import compare_methods, report_comparison
from lab.benchmarks.search.growth import measure_growth
from lab.benchmarks.search.load import measure_load
from lab.benchmarks.search.synthetic_map import (
    CHUNK_ROWS,
    SyntheticCity,
    create_synthetic_map,
    required_memory_bytes,
)

if TYPE_CHECKING:
    from rich.progress import Progress

SEED = 20_261_121


def measure(
    progress: Progress,
    *,
    photos: Sequence[int],
    dimensions: Sequence[int],
    queries: int,
    growth: bool,
    load_seconds: float,
    folder: Path | None = None,
) -> Report:
    """Run the benchmark for every number of `photos` and every one of `dimensions`.

    Each kind of query is run `queries` times. The largest map of the longest descriptors is also
    searched with a cold cache, and by many clients for `load_seconds`. Files are written to a
    temporary folder below `folder`, which must be on a real disk: 600 kB per photo of 98,304
    dimensions.
    """
    report = Report("Search", details={"comparisons": []})
    for dimension in sorted(dimensions, reverse=True):
        city = SyntheticCity(dimension, SEED)
        for count in sorted(photos):
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
                        if load_seconds:
                            measure_load(report, world, city, load_seconds, progress)
    if growth:
        measure_growth(report, progress)
    return report
