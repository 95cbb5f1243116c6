"""Exact nearest rows by cosine, in bounded memory: blocks of the database, a running merge.

Each block is searched by faiss (inner products of IndexFlatIP's kind). Products in float32 differ
in their last digits with where a row lies in a block. So candidates that are nearly equal are
compared again in float64, and what is equal then goes by index: a ranking is the same for any
block size, and copies of a photo are nobody's luck.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import faiss
import numpy as np
from numpy.typing import NDArray

from shared.errors import Misconfigured

BLOCK_BYTES = 256_000_000  # of database rows, and as much of queries, that are in memory at once
EXTRA_CANDIDATES = (
    12  # candidates beyond the first k, so that most near ties are settled among them
)
TIE_TOLERANCE = (
    1e-5  # of a cosine; some ten times what float32 loses in products of 100,000 numbers
)

Rows = NDArray[np.float32]
Scores = NDArray[np.float32]
Indices = NDArray[np.int64]
BlockProgress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Rankings:
    """Of each query, the best first."""

    indices: Indices
    """(queries, k) of database rows"""
    scores: Scores
    """(queries, k) cosines"""


def exact_knn(
    queries: Rows,
    database: Rows,
    k: int,
    *,
    faiss_gpu: bool = False,
    block_bytes: int = BLOCK_BYTES,
    on_progress: BlockProgress = lambda done, most: None,
) -> Rankings:
    """(n, D) and (m, D) unit rows, which may be memory-mapped -> the first min(k, m) of each query.

    Of equally similar rows the lower index comes first. `on_progress` hears how many products
    of rows are
    done, and of how many. Raises Misconfigured (`faiss_gpu_missing`).
    """
    search = _make_gpu_search() if faiss_gpu else _search_cpu
    k = min(k, len(database))
    at_once = max(1, block_bytes // (4 * max(1, database.shape[1])))
    found = Rankings(np.empty((len(queries), k), np.int64), np.empty((len(queries), k), np.float32))
    most, done = len(queries) * len(database), 0
    for start in range(0, len(queries), at_once):
        asked = np.ascontiguousarray(queries[start : start + at_once], np.float32)
        merged: Rankings | None = None
        for begin in range(0, len(database), at_once):
            block = np.ascontiguousarray(database[begin : begin + at_once], np.float32)
            kept = min(k + EXTRA_CANDIDATES, len(block))
            scores, indices = search(asked, block, kept)
            here = Rankings(indices.astype(np.int64) + begin, scores)
            merged = here if merged is None else _merge_top_k(merged, here, k + EXTRA_CANDIDATES)
            done += len(asked) * len(block)
            on_progress(done, most)
        if merged is None:  # an empty database
            continue
        settled = _resolve_ties(merged, asked, database, k, at_once)
        found.indices[start : start + len(asked)] = settled.indices
        found.scores[start : start + len(asked)] = settled.scores
    return found


def _search_cpu(queries: Rows, block: Rows, k: int) -> tuple[Scores, Indices]:
    scores, indices = faiss.knn(queries, block, k, metric=faiss.METRIC_INNER_PRODUCT)
    return scores, indices


def _make_gpu_search() -> Callable[[Rows, Rows, int], tuple[Scores, Indices]]:
    if not hasattr(faiss, "StandardGpuResources") or faiss.get_num_gpus() == 0:
        raise Misconfigured(
            "faiss_gpu_missing",
            "This faiss has no GPU: the package faiss-cpu is installed, or no GPU is there. Search "
            "on the processor (training: --faiss_gpu False; else without --faiss-gpu), or install "
            "a faiss for GPUs.",
        )
    resources = faiss.StandardGpuResources()

    def search(queries: Rows, block: Rows, k: int) -> tuple[Scores, Indices]:
        scores, indices = faiss.knn_gpu(
            resources, queries, block, k, metric=faiss.METRIC_INNER_PRODUCT
        )
        return scores, indices

    return search


def _merge_top_k(one: Rankings, other: Rankings, kept: int) -> Rankings:
    """The `kept` best of both, per query."""
    indices = np.concatenate([one.indices, other.indices], axis=1)
    scores = np.concatenate([one.scores, other.scores], axis=1)
    order = np.lexsort((indices, -scores), axis=1)[:, :kept]
    return Rankings(np.take_along_axis(indices, order, 1), np.take_along_axis(scores, order, 1))


def _resolve_ties(found: Rankings, queries: Rows, database: Rows, k: int, at_once: int) -> Rankings:
    """The first k of each query, near ties decided in float64."""
    kept = found.indices.shape[1]
    gaps = -np.diff(found.scores, axis=1)
    near = (gaps[:, : min(k, kept - 1)] < TIE_TOLERANCE).any(axis=1)
    # From the kth to the last candidate all nearly equal: there may be more of them.
    crowded = kept < len(database)
    open_ended = near & crowded & (found.scores[:, k - 1] - found.scores[:, -1] < TIE_TOLERANCE)
    indices, scores = found.indices[:, :k].copy(), found.scores[:, :k].copy()
    for place in np.flatnonzero(near & ~open_ended):
        among = np.sort(found.indices[place])
        exact = _cosines_float64(queries[place : place + 1], database[among])[0]
        order = np.argsort(-exact, kind="stable")[:k]
        indices[place], scores[place] = among[order], exact[order]
    doubtful = np.flatnonzero(open_ended)
    if len(doubtful):
        best = _search_float64(queries[doubtful], database, k, at_once)
        indices[doubtful], scores[doubtful] = best.indices, best.scores
    return Rankings(indices, scores)


def _search_float64(queries: Rows, database: Rows, k: int, at_once: int) -> Rankings:
    """As `nearest`, but every product in float64."""
    merged: Rankings | None = None
    step = max(1, at_once // 2)  # float64 takes twice the room
    for begin in range(0, len(database), step):
        exact = _cosines_float64(queries, database[begin : begin + step])
        order = np.argsort(-exact, axis=1, kind="stable")[:, :k]
        here = Rankings(order + begin, np.take_along_axis(exact, order, 1))
        merged = here if merged is None else _merge_top_k(merged, here, k)
    assert merged is not None, "asked of a database with rows"
    return merged


def _cosines_float64(queries: Rows, rows: Rows) -> Scores:
    """Cosines computed in float64: equal rows get the same float32."""
    return (queries.astype(np.float64) @ rows.astype(np.float64).T).astype(np.float32)
