"""Compared search methods: Placewise and its baselines NumPy, faiss and AnyLoc's service.

The ground truth is brute force in float64.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from uuid import UUID

import faiss
import numpy as np
from numpy.typing import NDArray

from benchmarks.search.memory_traffic import count_bytes_read
from benchmarks.search.synthetic_map import SyntheticMap
from services.search.executor import SearchOptions, execute_query
from services.search.worker import SearchWorker
from shared.codes.rotation import get_rotation
from shared.codes.sign_codes import SignCodes, pack_signs
from shared.storage.chunks import Rows

BLOCK_ROWS = 128  # rows converted to float64 at a time: 100 MB at 98,304 dimensions
DECIMALS = 12  # scores equal to this precision are ties, which are ordered by photo id
TOLERANCE = 1e-9  # of a score; float64 sums of 98,304 products differ by less than 1e-14

Ranking = Sequence[tuple[UUID, float]]
"""Photos with their cosines, best first."""


@dataclass(frozen=True, slots=True, eq=False)
class BruteForce:
    """Cosines of n photos with q queries, in float64."""

    photo_ids: Sequence[UUID]
    scores: NDArray[np.float64]
    """(q, n)"""

    @classmethod
    def of(cls, pieces: Iterable[Rows], photo_ids: Sequence[UUID], queries: Rows) -> BruteForce:
        """Compute the cosines; `pieces` are the photos' L2-normalised rows, in order."""
        unit_queries = queries.astype(np.float64)
        unit_queries /= np.linalg.norm(unit_queries, axis=1, keepdims=True)
        scores = np.empty((len(queries), len(photo_ids)))
        done = 0
        for rows in pieces:
            for start in range(0, len(rows), BLOCK_ROWS):
                block = rows[start : start + BLOCK_ROWS].astype(np.float64)
                scores[:, done : done + len(block)] = unit_queries @ block.T
                done += len(block)
        if done != len(photo_ids):
            raise ValueError(f"{done} rows of {len(photo_ids)} photos")
        return cls(photo_ids, np.round(scores, DECIMALS))

    def best(
        self,
        query: int,
        k: int,
        min_score: float | None = None,
        live: NDArray[np.bool_] | None = None,
    ) -> Ranking:
        """Return the result of query number `query` among the photos that are `live`, (n,) bool."""
        scores = self.scores[query]
        mask = np.ones(len(scores), bool) if live is None else live.copy()
        if min_score is not None:
            mask &= scores >= min_score
        candidates = np.flatnonzero(mask)
        if len(candidates) > k:
            kth = np.partition(scores[candidates], len(candidates) - k)[len(candidates) - k]
            candidates = candidates[scores[candidates] >= kth]
        ranked = sorted((-float(scores[row]), self.photo_ids[row]) for row in candidates.tolist())
        return [(photo_id, -score) for score, photo_id in ranked[:k]]


def same_ranking(found: Ranking, expected: Ranking) -> bool:
    """Return whether photos, order and scores are the same."""
    return len(found) == len(expected) and all(
        ours[0] == truth[0] and abs(ours[1] - truth[1]) <= TOLERANCE
        for ours, truth in zip(found, expected, strict=True)
    )


def same_photos(found: Ranking, expected: Ranking) -> bool:
    """Return whether the photos are the same, for methods that compute scores in float32."""
    return [photo_id for photo_id, _ in found] == [photo_id for photo_id, _ in expected]


MIN_CANDIDATES = 32  # candidates of the binary index that are reranked exactly


@dataclass(frozen=True, slots=True)
class BenchmarkQuery:
    """A search: index `query` of the query's row, number of results, minimum score."""

    query: int
    k: int
    min_score: float | None = None


class SearchMethod(Protocol):
    """Interface of a compared search method."""

    name: str
    memory_bytes: int
    """size of the index, without the page cache of files"""

    def search(self, params: BenchmarkQuery) -> Ranking: ...

    def bytes_touched(self, params: BenchmarkQuery) -> int:
        """Return the number of bytes of codes and rows that the search reads."""


class PlacewiseSearch:
    """Placewise's search on a loaded snapshot, called directly."""

    name = "Placewise, answer()"

    def __init__(self, world: SyntheticMap, worker: SearchWorker, queries: Rows) -> None:
        self._snapshot = worker.snapshot(world.generation_id, world.version)
        self._query_batcher = worker.query_batcher
        self._queries = queries
        self._mask = self._snapshot.photos.findable
        self.memory_bytes = worker.status().resident_bytes
        self.certificates: set[str] = set()

    def search(self, params: BenchmarkQuery) -> Ranking:
        found = execute_query(
            self._snapshot,
            self._queries[params.query],
            self._mask,
            SearchOptions(params.k, params.min_score),
            self._query_batcher,
        )
        self.certificates.add(found.certificate)
        return [(hit.photo_id, hit.score) for hit in found.hits]

    def bytes_touched(self, params: BenchmarkQuery) -> int:
        with count_bytes_read() as count:
            self.search(params)
        # Without codes every row is read.
        return count.size_bytes or int(self._queries[0].nbytes) * len(self._mask)


class PlacewiseWorker:
    """The same through the search worker, which reads the query's descriptor from the store."""

    name = "Placewise, SearchWorker"

    def __init__(
        self, world: SyntheticMap, worker: SearchWorker, queries: Rows, ours: PlacewiseSearch
    ) -> None:
        self._world = world
        self._worker = worker
        self._version = world.version
        self._keys = [world.store_query(row) for row in queries]
        self._ours = ours
        self.memory_bytes = ours.memory_bytes

    def search(self, params: BenchmarkQuery) -> Ranking:
        request = self._world.request(
            self._keys[params.query], params.k, self._version, params.min_score
        )
        return [(hit.photo_id, hit.score) for hit in self._worker.search(request).hits]

    def bytes_touched(self, params: BenchmarkQuery) -> int:
        return self._ours.bytes_touched(params)


class NumpySearch:
    """All rows in one float32 array."""

    name = "NumPy, resident float32"

    def __init__(self, rows: Rows, photo_ids: Sequence[UUID], queries: Rows) -> None:
        self._rows = rows
        self._ids = photo_ids
        self._queries = queries
        self.memory_bytes = rows.nbytes

    def search(self, params: BenchmarkQuery) -> Ranking:
        return top_k(self._rows @ self._queries[params.query], self._ids, params)

    def bytes_touched(self, params: BenchmarkQuery) -> int:
        return self._rows.nbytes


class AnyLocSearch:
    """Loads every chunk for every query, as AnyLoc's similarity service does."""

    name = "predecessor: np.load of every chunk"
    memory_bytes = 0

    def __init__(self, paths: Sequence[Path], photo_ids: Sequence[UUID], queries: Rows) -> None:
        self._paths = paths
        self._ids = photo_ids
        self._queries = queries

    def search(self, params: BenchmarkQuery) -> Ranking:
        query = self._queries[params.query]
        scores = np.concatenate([np.dot(np.load(path), query) for path in self._paths])
        return top_k(scores, self._ids, params)

    def bytes_touched(self, params: BenchmarkQuery) -> int:
        return int(self._queries[0].nbytes) * len(self._ids)


class FaissFlat:
    """`faiss.IndexFlatIP`; shares its rows with NumPy, to hold a single copy."""

    name = "faiss.IndexFlatIP"

    def __init__(self, index: faiss.IndexFlatIP, photo_ids: Sequence[UUID], queries: Rows) -> None:
        self._index = index
        self._ids = photo_ids
        self._queries = queries
        self.memory_bytes = int(queries[0].nbytes) * len(photo_ids)

    def search(self, params: BenchmarkQuery) -> Ranking:
        query = self._queries[params.query]
        k = min(params.k, len(self._ids))
        scores, numbers = self._index.search(query[np.newaxis], k)
        found = zip(numbers[0].tolist(), scores[0].tolist(), strict=True)
        min_score = -np.inf if params.min_score is None else params.min_score
        return [(self._ids[number], score) for number, score in found if score >= min_score]

    def bytes_touched(self, params: BenchmarkQuery) -> int:
        return self.memory_bytes


class FaissBinary:
    """`faiss.IndexBinaryFlat` on the sign codes, with exact reranking of its candidates.

    The number of candidates that suffices for an exact result is unknown.
    """

    name = "faiss.IndexBinaryFlat + rerank"

    def __init__(
        self, codes: SignCodes, rows: Rows, photo_ids: Sequence[UUID], queries: Rows
    ) -> None:
        words = np.concatenate(codes.levels, axis=1).view(np.uint8)
        self._index = faiss.IndexBinaryFlat(8 * words.shape[1])
        self._index.add(words)
        self._rows = rows
        self._ids = photo_ids
        self._queries = queries
        self._turn = get_rotation(rows.shape[1])
        self.memory_bytes = words.nbytes

    def search(self, params: BenchmarkQuery) -> Ranking:
        query = self._queries[params.query]
        code = pack_signs(self._turn.rotate(query[np.newaxis])).view(np.uint8)
        _, numbers = self._index.search(code, self._candidates(params))
        rows = numbers[0]
        scores = self._rows[rows].astype(np.float64) @ query.astype(np.float64)
        return top_k(scores, [self._ids[row] for row in rows.tolist()], params)

    def bytes_touched(self, params: BenchmarkQuery) -> int:
        return self.memory_bytes + self._candidates(params) * self._rows.strides[0]

    def _candidates(self, params: BenchmarkQuery) -> int:
        return min(max(MIN_CANDIDATES, 3 * params.k), len(self._ids))


def top_k(
    scores: NDArray[np.floating[np.typing.NBitBase]],
    photo_ids: Sequence[UUID],
    params: BenchmarkQuery,
) -> Ranking:
    """Return the top k of the scores of all rows, which are in the order of the photos."""
    k = min(params.k, len(scores))
    best = np.argpartition(scores, len(scores) - k)[len(scores) - k :]
    if params.min_score is not None:
        best = best[scores[best] >= params.min_score]
    best = best[np.argsort(-scores[best], kind="stable")]
    return [(photo_ids[row], float(scores[row])) for row in best.tolist()]
