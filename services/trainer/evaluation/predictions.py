"""Predictions as the predecessor wrote them: (queries, k) database indices, the best first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from services.trainer.evaluation.nearest import Indices
from shared.errors import InvalidRequest

MAX_ENTRIES_SHOWN = 5  # wrong entries that an error names


def read_predictions(path: Path) -> Indices:
    """(queries, k) int64 from an `.npy` file.

    Raises InvalidRequest: `predictions_unreadable`, `predictions_empty`, `bad_predictions` (no
    two-dimensional array of whole numbers, or a number below 0).
    """
    try:
        found = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InvalidRequest(
            "predictions_unreadable", f"{path} can't be read as predictions in .npy: {error}."
        ) from error
    if not isinstance(found, np.ndarray) or found.ndim != 2 or found.dtype.kind not in "iu":
        what = f"{found.dtype} {found.shape}" if isinstance(found, np.ndarray) else "an archive"
        raise InvalidRequest(
            "bad_predictions",
            f"{path} holds {what}; predictions are whole numbers (queries, k): of each query, the "
            "indices of the database photos found, the best first.",
        )
    if 0 in found.shape:
        raise InvalidRequest(
            "predictions_empty",
            f"{path} has the shape {found.shape}: it says nothing about any query. The run that "
            "wrote it had failed; make it again.",
        )
    ranked = found.astype(np.int64)
    if ranked.min() < 0:
        raise _out_of_range(path, ranked, ranked < 0, "indices are counted from 0")
    return ranked


def check_predictions(
    path: Path, ranked: Indices, positives: Sequence[Indices], database_size: int | None
) -> None:
    """Whether they can be about these queries, and about a database of that many photos; None
    where nobody has said how many.

    Raises InvalidRequest: `predictions_of_other_queries`, `bad_predictions`.
    """
    if len(ranked) != len(positives):
        raise InvalidRequest(
            "predictions_of_other_queries",
            f"{path} holds predictions for {len(ranked)} queries, the ground truth is of "
            f"{len(positives)}. Both have to be of the same list, in the same order.",
        )
    if database_size is not None and ranked.max() >= database_size:
        raise _out_of_range(
            path,
            ranked,
            ranked >= database_size,
            f"the database has {database_size} photos, 0 the first",
        )


def _out_of_range(
    path: Path, ranked: Indices, wrong: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], why: str
) -> InvalidRequest:
    where = np.argwhere(wrong)
    named = ", ".join(f"{ranked[q, k]} of query {q}" for q, k in where[:MAX_ENTRIES_SHOWN].tolist())
    more = f" and {len(where) - MAX_ENTRIES_SHOWN} more" if len(where) > MAX_ENTRIES_SHOWN else ""
    return InvalidRequest("bad_predictions", f"{path} is out of range: {named}{more}; {why}.")
