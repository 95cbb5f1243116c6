"""Exact k-nearest-neighbour search by cosine similarity, in bounded memory.

The database is searched in blocks with faiss (brute-force inner product, as IndexFlatIP), and the
top k of the blocks are merged. Float32 products depend in their last digits on a row's position in
the block. Near ties are therefore recomputed in float64, and exact ties are ordered by index. The
ranking is the same for any block size, also if the database holds copies of a photo.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import faiss
import numpy as np
from numpy.typing import NDArray

from shared.errors import Misconfigured

BLOCK_BYTES = 256_000_000  # size of a block of database rows, and of a block of queries
EXTRA_CANDIDATES = 12  # beyond the first k; most near ties can be resolved among them
TIE_TOLERANCE = 1e-5  # cosine; about ten times the float32 error of 100,000-dimensional products

Rows = NDArray[np.float32]
Scores = NDArray[np.float32]
Indices = NDArray[np.int64]
BlockProgress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Rankings:
    """Top k of each query, best first."""

    indices: Indices
    """(queries, k) int64 indices of database rows"""
    scores: Scores
    """(queries, k) float32 cosines"""


def exact_knn(
    queries: Rows,
    database: Rows,
    k: int,
    *,
    faiss_gpu: bool = False,
    block_bytes: int = BLOCK_BYTES,
    on_progress: BlockProgress = lambda done, total: None,
) -> Rankings:
    """Search the k nearest database rows of each query by cosine similarity.

    `queries` are (n, D) and `database` (m, D) float32 L2-normalised rows, which may be mapped.
    `on_progress` is called with the numbers of finished and of all comparisons.

    Returns (n, min(k, m)) rankings; equally similar rows are ordered by index. Raises
    Misconfigured (`faiss_gpu_missing`).
    """
    search = _make_gpu_search() if faiss_gpu else _search_cpu
    k = min(k, len(database))
    block_rows = max(1, block_bytes // (4 * max(1, database.shape[1])))
    result = Rankings(
        np.empty((len(queries), k), np.int64), np.empty((len(queries), k), np.float32)
    )
    total, done = len(queries) * len(database), 0
    for query_start in range(0, len(queries), block_rows):
        batch = np.ascontiguousarray(queries[query_start : query_start + block_rows], np.float32)
        merged: Rankings | None = None
        for start in range(0, len(database), block_rows):
            block = np.ascontiguousarray(database[start : start + block_rows], np.float32)
            candidates = min(k + EXTRA_CANDIDATES, len(block))
            scores, indices = search(batch, block, candidates)
            top = Rankings(indices.astype(np.int64) + start, scores)
            merged = top if merged is None else _merge_top_k(merged, top, k + EXTRA_CANDIDATES)
            done += len(batch) * len(block)
            on_progress(done, total)
        if merged is None:  # an empty database
            continue
        resolved = _resolve_ties(merged, batch, database, k, block_rows)
        result.indices[query_start : query_start + len(batch)] = resolved.indices
        result.scores[query_start : query_start + len(batch)] = resolved.scores
    return result


def _search_cpu(queries: Rows, block: Rows, k: int) -> tuple[Scores, Indices]:
    scores, indices = faiss.knn(queries, block, k, metric=faiss.METRIC_INNER_PRODUCT)
    return scores, indices


def has_faiss_gpu() -> bool:
    """Return whether faiss was built for GPUs and finds one."""
    return hasattr(faiss, "StandardGpuResources") and faiss.get_num_gpus() > 0


def _make_gpu_search() -> Callable[[Rows, Rows, int], tuple[Scores, Indices]]:
    if not has_faiss_gpu():
        raise Misconfigured(
            "faiss_gpu_missing",
            "faiss cannot use a GPU: either the package faiss-cpu is installed, or there is no "
            "GPU. Omit --faiss-gpu: the search on the CPU is as exact. Or install faiss with GPU "
            "support.",
        )
    resources = faiss.StandardGpuResources()

    def search(queries: Rows, block: Rows, k: int) -> tuple[Scores, Indices]:
        scores, indices = faiss.knn_gpu(
            resources, queries, block, k, metric=faiss.METRIC_INNER_PRODUCT
        )
        return scores, indices

    return search


def _merge_top_k(first: Rankings, second: Rankings, k: int) -> Rankings:
    indices = np.concatenate([first.indices, second.indices], axis=1)
    scores = np.concatenate([first.scores, second.scores], axis=1)
    order = np.lexsort((indices, -scores), axis=1)[:, :k]
    return Rankings(np.take_along_axis(indices, order, 1), np.take_along_axis(scores, order, 1))


def _resolve_ties(
    ranked: Rankings, queries: Rows, database: Rows, k: int, block_rows: int
) -> Rankings:
    """Return the top k of each query, with near ties recomputed in float64."""
    candidates = ranked.indices.shape[1]
    gaps = -np.diff(ranked.scores, axis=1)
    has_tie = (gaps[:, : min(k, candidates - 1)] < TIE_TOLERANCE).any(axis=1)
    # If the kth to the last candidate are nearly equal, rows beyond the candidates may be as well.
    is_truncated = candidates < len(database)
    is_open = (
        has_tie & is_truncated & (ranked.scores[:, k - 1] - ranked.scores[:, -1] < TIE_TOLERANCE)
    )
    indices, scores = ranked.indices[:, :k].copy(), ranked.scores[:, :k].copy()
    for query in np.flatnonzero(has_tie & ~is_open):
        rows = np.sort(ranked.indices[query])
        exact = _cosines_float64(queries[query : query + 1], database[rows])[0]
        order = np.argsort(-exact, kind="stable")[:k]
        indices[query], scores[query] = rows[order], exact[order]
    unresolved = np.flatnonzero(is_open)
    if len(unresolved):
        best = _search_float64(queries[unresolved], database, k, block_rows)
        indices[unresolved], scores[unresolved] = best.indices, best.scores
    return Rankings(indices, scores)


def _search_float64(queries: Rows, database: Rows, k: int, block_rows: int) -> Rankings:
    """Search as `exact_knn`, with all products in float64."""
    merged: Rankings | None = None
    step = max(1, block_rows // 2)  # float64 takes twice the memory
    for start in range(0, len(database), step):
        exact = _cosines_float64(queries, database[start : start + step])
        order = np.argsort(-exact, axis=1, kind="stable")[:, :k]
        top = Rankings(order + start, np.take_along_axis(exact, order, 1))
        merged = top if merged is None else _merge_top_k(merged, top, k)
    assert merged is not None, "the database has rows"
    return merged


def _cosines_float64(queries: Rows, rows: Rows) -> Scores:
    """Compute cosines in float64, so that equal rows get the same float32 value."""
    return (queries.astype(np.float64) @ rows.astype(np.float64).T).astype(np.float32)
