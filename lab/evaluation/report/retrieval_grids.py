"""Retrieval grids of a report: a row per query with its first matches.

The query is framed in blue, a correct match in green, a wrong one in red.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lab.datasets.dataset import DatasetPhoto
from lab.evaluation.results import EvaluationResult
from shared.errors import Unprocessable
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import get_preprocessing

COLUMNS_SHOWN = 5  # database photos per row
MAX_NAME_CHARACTERS = 34
MAX_PIXELS = 200_000_000
_THUMBNAIL_PREPROCESSING = get_preprocessing("square32")  # only the decoder's thumbnail is used


@dataclass(frozen=True, slots=True)
class Cell:
    """A photo of a grid."""

    name: str
    kind: str
    """CSS classes: `query`, `right`, `wrong` or `right missed`"""
    caption: str
    picture: str | None
    """data URI of the thumbnail; None if the photo can't be read or decoded"""

    @property
    def short_name(self) -> str:
        if len(self.name) <= MAX_NAME_CHARACTERS:
            return self.name
        return "…" + self.name[1 - MAX_NAME_CHARACTERS :]


@dataclass(frozen=True, slots=True)
class Grid:
    """A table of photos; None is an empty cell."""

    heading: str
    heads: list[str]
    rows: list[list[Cell | None]]


def retrieval_grids(result: EvaluationResult, max_rows: int, *, only_wrong: bool) -> list[Grid]:
    """Make the grids of wrong, unfindable and correct queries, as far as there are some.

    Wrong queries are sorted by descending score of the first match, correct ones by ascending
    score.
    """
    is_correct = result.measured.hits[:, 0]
    findable = np.array([len(rows) > 0 for rows in result.evaluation_set.positives])
    scores = np.zeros(len(is_correct)) if result.scores is None else result.scores[:, 0]
    order = np.argsort(-scores, kind="stable")
    descending = ", highest score first" if result.has_scores else ""
    ascending = ", lowest score first" if result.has_scores else ""
    grids = {
        f"Wrong{descending}": order[~is_correct[order] & findable[order]],
        f"Without a positive{descending}": order[~findable[order]],
    }
    if not only_wrong:
        grids[f"Correct{ascending}"] = order[::-1][is_correct[order[::-1]]]
    return _make_grids(result, grids, max_rows)


def changed_grids(result: EvaluationResult, max_rows: int) -> list[Grid]:
    """Make the grids of the queries that were lost and won against another run."""
    if result.against is None:
        return []
    changes = {
        "Lost at rank 1": np.array(result.against.lost, np.int64),
        "Won at rank 1": np.array(result.against.won, np.int64),
    }
    return _make_grids(result, changes, max_rows)


def _make_grids(
    result: EvaluationResult, queries: dict[str, np.ndarray], max_rows: int
) -> list[Grid]:
    return [
        _make_grid(
            result,
            f"{heading}: {min(max_rows, len(numbers))} of {len(numbers)}",
            numbers[:max_rows].tolist(),
        )
        for heading, numbers in queries.items()
        if len(numbers)
    ]


def _make_grid(result: EvaluationResult, heading: str, queries: Sequence[int]) -> Grid:
    """A last column shows a positive of each query that has none among the shown matches."""
    shown = min(COLUMNS_SHOWN, result.measured.depth)
    heads = ["query", *(f"{rank + 1}" for rank in range(shown))]
    rows = [_make_row(result, query, shown) for query in queries]
    if any(not result.measured.hits[query, :shown].any() for query in queries):
        heads.append("a positive")
        for query, row in zip(queries, rows, strict=True):
            row.append(_missed_positive(result, query, shown))
    return Grid(heading, heads, rows)


def _make_row(result: EvaluationResult, query: int, shown: int) -> list[Cell | None]:
    photo = result.evaluation_set.queries[query]
    cells: list[Cell | None] = [_make_cell(photo, photo.name, "query", "")]
    metres = result.measured.metres
    for rank in range(shown):
        is_right = result.measured.hits[query, rank]
        details = [] if result.scores is None else [f"{result.scores[query, rank]:.3f}"]
        if metres is not None and np.isfinite(metres[query, rank]):
            details.append(f"{metres[query, rank]:.0f} m")
        caption = " · ".join(filter(None, ("correct" if is_right else "wrong", ", ".join(details))))
        kind, name = "right" if is_right else "wrong", result.match_name(query, rank)
        cells.append(_make_cell(result.match(query, rank), name, kind, caption))
    return cells


def _missed_positive(result: EvaluationResult, query: int, shown: int) -> Cell | None:
    positives = result.evaluation_set.positives[query]
    if result.measured.hits[query, :shown].any() or not len(positives):
        return None
    index, database = int(positives[0]), result.evaluation_set.database
    photo = database[index] if database else None
    name = photo.name if photo else str(index)
    return _make_cell(photo, name, "right missed", "not retrieved")


def _make_cell(photo: DatasetPhoto | None, name: str, kind: str, caption: str) -> Cell:
    return Cell(name, kind, caption, _thumbnail(photo.path) if photo else None)


def _thumbnail(path: Path) -> str | None:
    try:
        thumbnail = decode_photo(path.read_bytes(), _THUMBNAIL_PREPROCESSING, MAX_PIXELS).thumbnail
    except (OSError, Unprocessable):
        return None
    return "data:image/jpeg;base64," + base64.b64encode(thumbnail).decode()
