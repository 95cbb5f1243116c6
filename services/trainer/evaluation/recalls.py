"""An evaluation set asked of something that describes photos: rankings and recall@k."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from services.trainer.evaluation.describe import MEMORY_BYTES, Describe, Rows, described
from services.trainer.evaluation.nearest import BLOCK_BYTES, Indices, Ranked, nearest
from shared.datasets.recall import recall_at
from shared.datasets.sets import EvaluationSet

KS = (1, 5, 10, 20)

Told = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Recalls:
    """The shares are from 0 to 1; NaN where there is no query to take them of."""

    of_all: dict[int, float]
    """By k; a query without a positive counts as missed. What papers print."""
    of_findable: dict[int, float]
    """By k, over the queries that have a positive."""
    queries: int
    without_positive: int

    def as_json(self) -> dict[str, Any]:
        return {
            "queries": self.queries,
            "without_positive": self.without_positive,
            "recall": _by_k(self.of_all),
            "recall_findable": _by_k(self.of_findable),
        }


@dataclass(frozen=True, slots=True)
class Asked:
    """What came of one evaluation set."""

    ranked: Ranked
    recalls: Recalls
    dimension: int
    """of a row; 4 bytes a number"""


def recalls(
    describe: Describe,
    asked: EvaluationSet,
    *,
    ks: Sequence[int] = KS,
    faiss_gpu: bool = False,
    memory_bytes: int = MEMORY_BYTES,
    block_bytes: int = BLOCK_BYTES,
    told: Told = lambda what, done, most: None,
) -> Asked:
    """Describe the database and the queries, rank, count.

    `told` hears what is being done (`database`, `queries`, `search`), how far it is and where it
    ends. Raises what `describe` does, and Misconfigured (`faiss_gpu_missing`).
    """
    with rows_of_set(describe, asked, memory_bytes=memory_bytes, told=told) as (database, queries):
        ranked = nearest(
            queries,
            database,
            max(ks),
            faiss_gpu=faiss_gpu,
            block_bytes=block_bytes,
            told=lambda done, most: told("search", done, most),
        )
        dimension = database.shape[1]
    return Asked(ranked, count_recalls(ranked.indices, asked.positives, ks), dimension)


@contextlib.contextmanager
def rows_of_set(
    describe: Describe,
    asked: EvaluationSet,
    *,
    memory_bytes: int = MEMORY_BYTES,
    told: Told = lambda what, done, most: None,
) -> Iterator[tuple[Rows, Rows]]:
    """(m, D) rows of the database and (n, D) of the queries, for as long as the block lasts."""
    with contextlib.ExitStack() as stack:
        found = []
        for what, shots in (("database", asked.database), ("queries", asked.queries)):
            more = _counting(what, len(shots), told)
            paths = [shot.path for shot in shots]
            found.append(
                stack.enter_context(
                    described(describe, paths, memory_bytes=memory_bytes, told=more)
                )
            )
        database, queries = found
        yield database, queries


def _counting(what: str, most: int, told: Told) -> Callable[[int], None]:
    done = 0

    def more(count: int) -> None:
        nonlocal done
        done += count
        told(what, done, most)

    return more


def count_recalls(ranked: Indices, positives: Sequence[Indices], ks: Sequence[int] = KS) -> Recalls:
    """(queries, k) rankings and each query's positives -> both recalls."""
    findable = [place for place, found in enumerate(positives) if len(found)]
    return Recalls(
        of_all=recall_at(ranked, positives, ks),
        of_findable=recall_at(ranked[findable], [positives[p] for p in findable], ks),
        queries=len(positives),
        without_positive=len(positives) - len(findable),
    )


def _by_k(shares: dict[int, float]) -> dict[str, float | None]:
    """JSON has no NaN."""
    return {str(k): None if math.isnan(share) else share for k, share in shares.items()}
