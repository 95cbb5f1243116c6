"""How fast search is, next to what one would write without it, and whether it is ever wrong.

`places` makes descriptors and `world` a map of them; `oracle` knows the right answers; `methods`
are asked in `turns`, and `comparison` says what came of it. `cold`, `growth` and `load` measure
what their names say; `memory` tells how fast memory is read, and how much of it was.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.report import Report
from benchmarks.search.cold_cache import measure_cold_cache
from benchmarks.search.comparison import compare_methods, report_comparison
from benchmarks.search.growth import measure_growth
from benchmarks.search.load import measure_load
from benchmarks.search.synthetic_map import (
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
    """Every number of `photos` in every one of `dimensions`, `queries` of each kind. The largest
    map of the longest descriptors is asked cold, too, and by many clients for `load_seconds`.

    In a temporary folder below `folder`, on a real disk: 400 kB a photo of 98,304 dimensions.
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
