"""An evaluation set asked of something that describes photos: rankings and recall@k."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from services.trainer.evaluation.describe import (
    MAX_ROWS_IN_MEMORY_BYTES,
    DescribeFunction,
    Rows,
    describe_to_matrix,
)
from services.trainer.evaluation.nearest import BLOCK_BYTES, Indices, Rankings, exact_knn
from shared.datasets.recall import recall_at_k
from shared.datasets.sets import EvaluationSet

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

    `on_progress` hears what is being done (`database`, `queries`, `search`), how far it is and where it
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
