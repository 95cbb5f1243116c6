"""An evaluation set asked of something that describes photos: rankings and recall@k.

What describes photos, as evaluation sees it, and its rows in memory or in a mapped file.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from shared.datasets.open_dataset import EvaluationSet
from shared.errors import PlacewiseError, Unprocessable
from shared.evaluation.exact_knn import BLOCK_BYTES, Indices, Rankings, exact_knn
from shared.evaluation.recall import recall_at_k

MAX_ROWS_IN_MEMORY_BYTES = 1_000_000_000  # rows beyond it lie in a mapped file meanwhile
MAX_PHOTOS_LISTED = 20  # photos that an error lists; the others are counted

Rows = NDArray[np.float32]


class DescribeFunction(Protocol):
    """Photos to their rows, batch by batch, in the photos' order: (b, D) float32, unit length.

    A photo that can't be described is an Unprocessable error (`refused_photos_error`) that
    names it: a
    figure over the others would be one of another data set.
    """

    def __call__(self, photos: Sequence[Path]) -> Iterator[Rows]: ...


@contextlib.contextmanager
def describe_to_matrix(
    describe: DescribeFunction,
    photos: Sequence[Path],
    *,
    memory_bytes: int = MAX_ROWS_IN_MEMORY_BYTES,
    on_progress: Callable[[int], None] = lambda more: None,
) -> Iterator[Rows]:
    """(photos, D) rows for as long as the block lasts; `on_progress` hears how many more are there.

    Raises Unprocessable (`features_not_finite`, and what `describe` raises).
    """
    with contextlib.ExitStack() as stack:
        rows: Rows = np.empty((0, 0), np.float32)
        done = 0
        for batch in describe(photos):
            if done == 0:
                rows = _allocate_rows(len(photos), batch.shape[1], memory_bytes, stack)
            _check_finite(batch, photos[done : done + len(batch)])
            rows[done : done + len(batch)] = batch
            done += len(batch)
            on_progress(len(batch))
        if done != len(photos):
            raise ValueError(f"{done} rows for {len(photos)} photos")
        yield rows


def _allocate_rows(
    count: int, dimension: int, memory_bytes: int, stack: contextlib.ExitStack
) -> Rows:
    if 4 * count * dimension <= memory_bytes:
        return np.empty((count, dimension), np.float32)
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="placewise-rows-"))
    mapped: Rows = np.lib.format.open_memmap(
        Path(folder) / "rows.npy", mode="w+", dtype=np.float32, shape=(count, dimension)
    )
    return mapped


def _check_finite(batch: Rows, photos: Sequence[Path]) -> None:
    finite = np.isfinite(batch).all(axis=1)
    if not finite.all():
        first = photos[int(np.flatnonzero(~finite)[0])]
        raise Unprocessable(
            "features_not_finite",
            f"The network's descriptor of {first} is not finite, and {int((~finite).sum())} of its "
            "batch are not: check the weights; a training that has diverged makes such networks.",
        )


def refused_photos_error(
    refused: Sequence[tuple[Path, PlacewiseError]], photos: int
) -> Unprocessable:
    """The error that names the photos that can't be described, and why."""
    lines = [f"{photo}: {error.detail}" for photo, error in refused[:MAX_PHOTOS_LISTED]]
    if len(refused) > MAX_PHOTOS_LISTED:
        lines.append(f"and {len(refused) - MAX_PHOTOS_LISTED} more")
    return Unprocessable(
        "photos_refused",
        f"{len(refused)} of {photos} photos of the data set can't be described, and without them "
        "it would be another data set. Mend or fetch them again.\n" + "\n".join(lines),
    )


DEFAULT_KS = (1, 5, 10, 20)

ProgressCallback = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Recalls:
    """The shares are from 0 to 1; NaN where there is no query to take them of."""

    recall_all: dict[int, float]
    """By k; a query without a positive counts as missed. What papers print."""
    recall_findable: dict[int, float]
    """By k, over the queries that have a positive."""
    queries: int
    without_positive: int

    def as_json(self) -> dict[str, Any]:
        return {
            "queries": self.queries,
            "without_positive": self.without_positive,
            "recall": _shares_by_k(self.recall_all),
            "recall_findable": _shares_by_k(self.recall_findable),
        }


@dataclass(frozen=True, slots=True)
class RecallEvaluation:
    """What came of one evaluation set."""

    ranked: Rankings
    recalls: Recalls
    dimension: int
    """of a row; 4 bytes a number"""


def evaluate_recall(
    describe: DescribeFunction,
    evaluation_set: EvaluationSet,
    *,
    ks: Sequence[int] = DEFAULT_KS,
    faiss_gpu: bool = False,
    memory_bytes: int = MAX_ROWS_IN_MEMORY_BYTES,
    block_bytes: int = BLOCK_BYTES,
    on_progress: ProgressCallback = lambda what, done, most: None,
) -> RecallEvaluation:
    """Describe the database and the queries, rank, count.

    `on_progress` hears what is being done (`database`, `queries`, `search`), how far it is and
    where it
    ends. Raises what `describe` does, and Misconfigured (`faiss_gpu_missing`).
    """
    with describe_evaluation_set(
        describe, evaluation_set, memory_bytes=memory_bytes, on_progress=on_progress
    ) as (database, queries):
        ranked = exact_knn(
            queries,
            database,
            max(ks),
            faiss_gpu=faiss_gpu,
            block_bytes=block_bytes,
            on_progress=lambda done, most: on_progress("search", done, most),
        )
        dimension = database.shape[1]
    return RecallEvaluation(
        ranked, compute_recalls(ranked.indices, evaluation_set.positives, ks), dimension
    )


@contextlib.contextmanager
def describe_evaluation_set(
    describe: DescribeFunction,
    evaluation_set: EvaluationSet,
    *,
    memory_bytes: int = MAX_ROWS_IN_MEMORY_BYTES,
    on_progress: ProgressCallback = lambda what, done, most: None,
) -> Iterator[tuple[Rows, Rows]]:
    """(m, D) rows of the database and (n, D) of the queries, for as long as the block lasts."""
    with contextlib.ExitStack() as stack:
        found = []
        for what, shots in (
            ("database", evaluation_set.database),
            ("queries", evaluation_set.queries),
        ):
            more = _count_progress(what, len(shots), on_progress)
            paths = [shot.path for shot in shots]
            found.append(
                stack.enter_context(
                    describe_to_matrix(describe, paths, memory_bytes=memory_bytes, on_progress=more)
                )
            )
        database, queries = found
        yield database, queries


def _count_progress(stage: str, total: int, on_progress: ProgressCallback) -> Callable[[int], None]:
    done = 0

    def more(count: int) -> None:
        nonlocal done
        done += count
        on_progress(stage, done, total)

    return more


def compute_recalls(
    ranked: Indices, positives: Sequence[Indices], ks: Sequence[int] = DEFAULT_KS
) -> Recalls:
    """(queries, k) rankings and each query's positives -> both recalls."""
    findable = [place for place, found in enumerate(positives) if len(found)]
    return Recalls(
        recall_all=recall_at_k(ranked, positives, ks),
        recall_findable=recall_at_k(ranked[findable], [positives[p] for p in findable], ks),
        queries=len(positives),
        without_positive=len(positives) - len(findable),
    )


def _shares_by_k(shares: dict[int, float]) -> dict[str, float | None]:
    """JSON has no NaN."""
    return {str(k): None if math.isnan(share) else share for k, share in shares.items()}
