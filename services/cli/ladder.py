"""The ladder: how hard a generated city is, from average colour up to the default extractor.

Its lower rungs must find next to nothing and its upper ones must differ, or the city measures
nothing. Figures of a generated city are never comparable with published ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.progress import Progress

from shared.datasets.city.plan import Plan, Shot
from shared.datasets.recall import rank, recall_at, true_positives
from shared.datasets.weak_baselines import WEAK_BASELINES

KS = (1, 5, 10)

Rows = NDArray[np.float32]


def climb(plan: Plan, out: Path, progress: Progress) -> list[dict[str, Any]]:
    """Each rung's name and recalls over the queries on the map, weakest first.

    `recall` is over all of them; `recall_in_map` and `recall_other_way` over the two kinds, the
    latter None where there is none.
    """
    database = [shot for shot in plan.shots if shot.role == "database"]
    queries = [s for s in plan.shots if s.role == "query" and s.kind != "out_of_map"]
    if not queries:
        return []
    positives = true_positives(_positions(queries), _positions(database))
    other_way = np.array([shot.kind == "other_way" for shot in queries])
    rungs = []
    for name, described in _described(
        [out / s.folder / s.name for s in database + queries], len(database), progress
    ):
        ranked = rank(described[len(database) :], described[: len(database)], max(KS))
        rungs.append(
            {
                "rung": name,
                "recall": _shares(ranked, positives, np.ones(len(queries), bool)),
                "recall_in_map": _shares(ranked, positives, ~other_way),
                "recall_other_way": _shares(ranked, positives, other_way),
            }
        )
    return rungs


def _described(paths: Sequence[Path], database: int, progress: Progress) -> list[tuple[str, Rows]]:
    """(photos, D) unit rows by each rung; the first `database` paths may be learnt from."""
    from services.cli.network_rungs import NetworkRungs  # torch takes seconds

    bar = progress.add_task("ladder: no network", total=len(paths))
    weak: dict[str, list[Rows]] = {name: [] for name in WEAK_BASELINES}
    for path in paths:
        with Image.open(path) as image:
            photo = image.convert("RGB")
        for name, describe in WEAK_BASELINES.items():
            weak[name].append(describe(photo))
        progress.advance(bar)
    found = [(name, np.stack(rows)) for name, rows in weak.items()]
    bar = progress.add_task("ladder: networks", total=len(paths))
    advance: Callable[[int], None] = lambda count: progress.advance(bar, count)  # noqa: E731
    found += NetworkRungs(paths[:database]).describe(paths, advance).items()
    return found


def _positions(shots: Sequence[Shot]) -> NDArray[np.float64]:
    return np.array([(shot.camera.x, shot.camera.y) for shot in shots])


def _shares(
    ranked: NDArray[np.int64], positives: list[NDArray[np.int64]], which: NDArray[np.bool_]
) -> dict[str, float] | None:
    if not which.any():
        return None
    chosen = [found for found, meant in zip(positives, which, strict=True) if meant]
    return {str(k): share for k, share in recall_at(ranked[which], chosen, KS).items()}
