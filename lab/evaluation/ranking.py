"""Evaluates a descriptor on an evaluation set: describe, rank exactly, compute recall@k.

Descriptors are held in memory or, if they are large, in a memory-mapped temporary file.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lab.datasets.dataset import DatasetPhoto, EvaluationSet
from lab.evaluation.exact_knn import Indices, Rankings, exact_knn
from lab.evaluation.recall import recall_at_k
from shared.errors import PlacewiseError, Unprocessable

MAX_ROWS_IN_MEMORY_BYTES = 1_000_000_000  # larger matrices are memory-mapped
MAX_PHOTOS_LISTED = 20  # photos listed in an error message; the others are counted

Rows = NDArray[np.float32]


class DescribeFunction(Protocol):
    """Interface of descriptor extraction: yields (b, D) float32 L2-normalised rows, in order.

    If a photo cannot be described, implementations raise the Unprocessable error that
    `refused_photos_error` builds. Metrics over the remaining photos would be those of a different
    data set.
    """

    def __call__(self, photos: Sequence[Path]) -> Iterator[Rows]: ...


@contextlib.contextmanager
def describe_to_matrix(
    describe: DescribeFunction,
    photos: Sequence[Path],
    *,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Iterator[Rows]:
    """Describe photos into a (photos, D) float32 matrix that is valid inside the `with` block.

    `on_progress` is called with the numbers of described and of all photos. Raises what `describe`
    raises, and Unprocessable (`features_not_finite`).
    """
    with contextlib.ExitStack() as stack:
        rows: Rows = np.empty((0, 0), np.float32)
        done = 0
        for batch in describe(photos):
            if done == 0:
                rows = _allocate_rows(len(photos), batch.shape[1], stack)
            check_finite(batch, photos[done : done + len(batch)])
            rows[done : done + len(batch)] = batch
            done += len(batch)
            on_progress(done, len(photos))
        if done != len(photos):
            raise ValueError(f"{done} rows for {len(photos)} photos")
        yield rows


def _allocate_rows(count: int, dimension: int, stack: contextlib.ExitStack) -> Rows:
    if 4 * count * dimension <= MAX_ROWS_IN_MEMORY_BYTES:
        return np.empty((count, dimension), np.float32)
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="placewise-rows-"))
    mapped: Rows = np.lib.format.open_memmap(
        Path(folder) / "rows.npy", mode="w+", dtype=np.float32, shape=(count, dimension)
    )
    return mapped


def check_finite(batch: Rows, photos: Sequence[Any]) -> None:
    """Raise Unprocessable (`features_not_finite`) for rows of photos with NaN or infinity."""
    finite = np.isfinite(batch).all(axis=1)
    if not finite.all():
        first = photos[int(np.flatnonzero(~finite)[0])]
        raise Unprocessable(
            "features_not_finite",
            f"The network's descriptor of {first} has NaN or infinite values "
            f"({int((~finite).sum())} photos of its batch do). Check the weights; a diverged "
            "training produces such networks.",
        )


def refused_photos_error(
    refused: Sequence[tuple[Any, PlacewiseError]], photos: int
) -> Unprocessable:
    """Build the error that lists the photos that can't be described, with reasons."""
    named = [(str(photo).encode("utf-8", "replace").decode(), error) for photo, error in refused]
    lines = [f"{photo}: {error.detail}" for photo, error in named[:MAX_PHOTOS_LISTED]]
    if len(named) > MAX_PHOTOS_LISTED:
        lines.append(f"and {len(named) - MAX_PHOTOS_LISTED} more")
    return Unprocessable(
        "photos_refused",
        f"{len(named)} of {photos} photos can't be described. Nothing was measured or written "
        "without them.\n" + "\n".join(lines),
        refused=[
            {"photo": photo, "code": error.code, "detail": error.detail} for photo, error in named
        ],
    )


DEFAULT_KS = (1, 5, 10, 20)

ProgressCallback = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Recalls:
    """Recall@k of one evaluation set, from 0 to 1; NaN without queries."""

    recall_all: dict[int, float]
    """k -> recall over all queries, as papers report it; a query without a positive is a miss"""
    recall_findable: dict[int, float]
    """k -> recall over the queries that have a positive"""
    queries: int
    without_positive: int

    def as_json(self) -> dict[str, Any]:
        return {
            "queries": self.queries,
            "without_positive": self.without_positive,
            "recall": _recalls_as_json(self.recall_all),
            "recall_findable": _recalls_as_json(self.recall_findable),
        }


@dataclass(frozen=True, slots=True)
class RecallEvaluation:
    """Rankings and recalls of one evaluation set."""

    ranked: Rankings
    recalls: Recalls
    dimension: int
    """dimension of a descriptor"""


def evaluate_recall(
    describe: DescribeFunction,
    evaluation_set: EvaluationSet,
    *,
    ks: Sequence[int] = DEFAULT_KS,
    faiss_gpu: bool = False,
    on_progress: ProgressCallback = lambda what, done, total: None,
) -> RecallEvaluation:
    """Describe the database and the queries, rank them exactly, and compute recall@k.

    `on_progress` is called with the stage (`database`, `queries`, `search`), done and total. Raises
    what `describe` and `exact_knn` raise.
    """
    with describe_evaluation_set(describe, evaluation_set, on_progress) as (database, queries):
        search = partial(on_progress, "search")
        ranked = exact_knn(queries, database, max(ks), faiss_gpu=faiss_gpu, on_progress=search)
        dimension = database.shape[1]
    return RecallEvaluation(
        ranked, compute_recalls(ranked.indices, evaluation_set.positives, ks), dimension
    )


@contextlib.contextmanager
def describe_evaluation_set(
    describe: DescribeFunction,
    evaluation_set: EvaluationSet,
    on_progress: ProgressCallback = lambda what, done, total: None,
) -> Iterator[tuple[Rows, Rows]]:
    """Describe a set into the (m, D) float32 descriptors of its database and (n, D) of its queries.

    They are valid inside the `with` block.
    """

    def describe_photos(stage: str, photos: Sequence[DatasetPhoto]) -> AbstractContextManager[Rows]:
        paths = [photo.path for photo in photos]
        return describe_to_matrix(describe, paths, on_progress=partial(on_progress, stage))

    with (
        describe_photos("database", evaluation_set.database) as database,
        describe_photos("queries", evaluation_set.queries) as queries,
    ):
        yield database, queries


def compute_recalls(
    ranked: Indices, positives: Sequence[Indices], ks: Sequence[int] = DEFAULT_KS
) -> Recalls:
    """Compute both kinds of recall of (queries, depth) database indices, best first."""
    findable = [query for query, rows in enumerate(positives) if len(rows)]
    return Recalls(
        recall_all=recall_at_k(ranked, positives, ks),
        recall_findable=recall_at_k(ranked[findable], [positives[q] for q in findable], ks),
        queries=len(positives),
        without_positive=len(positives) - len(findable),
    )


def _recalls_as_json(recalls: dict[int, float]) -> dict[str, float | None]:
    # JSON has no NaN.
    return {str(k): None if math.isnan(recall) else recall for k, recall in recalls.items()}
