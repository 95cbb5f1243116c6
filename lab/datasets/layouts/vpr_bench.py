"""VPR-Bench's layout: numbered photos in `ref/` and `query/`, and `ground_truth_new.npy`.

The ground truth has a row for each query: its number, and the numbers of its reference photos. Both
are counted from 0 in numeric order of the file names. (Zaffar et al. 2021; AnyLoc reads the same.)
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from lab.datasets.ground_truth_files import read_numbered_ground_truth
from lab.datasets.layouts.base import EvaluationLayout, ListedSet, photos_below
from lab.datasets.photo_lists import photo_from_filename

GROUND_TRUTH = "ground_truth_new.npy"


class VprBench(EvaluationLayout):
    """Evaluation sets as two folders of numbered photos and a ground truth."""

    name = "VPR-Bench"

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        parts = (base / "ref", base / "query", base / GROUND_TRUTH)
        return {prefix: "."} if all(part.exists() for part in parts) else {}

    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        database, queries = (
            tuple(
                photo_from_filename(path, path.relative_to(base).as_posix())
                for path in sorted(photos_below(base / folder), key=_numeric_order)
            )
            for folder in ("ref", "query")
        )
        positives = read_numbered_ground_truth(
            base / GROUND_TRUTH,
            database=[photo.name for photo in database],
            queries=[photo.name for photo in queries],
        )
        return ListedSet(database, queries, f"given by {GROUND_TRUTH}", positives)


def _numeric_order(path: Path) -> list[tuple[int, str]]:
    """Sort key by which `9.jpg` precedes `10.jpg`."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [(int(part) if part.isdecimal() else 0, part) for part in parts]
