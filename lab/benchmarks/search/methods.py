"""Compared search methods: Placewise and its baselines NumPy, faiss and AnyLoc's service.

The ground truth is brute force in float64.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from uuid import UUID

import faiss
import numpy as np
from numpy.typing import NDArray

from lab.benchmarks.search.memory_traffic import count_bytes_read
from lab.benchmarks.search.synthetic_map import SyntheticMap
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
    """Return whether photos and order are equal and scores differ by at most TOLERANCE."""
    return len(found) == len(expected) and all(
        ours[0] == truth[0] and abs(ours[1] - truth[1]) <= TOLERANCE
        for ours, truth in zip(found, expected, strict=True)
    )


def same_photos(found: Ranking, expected: Ranking) -> bool:
    """Return whether photos and order are equal, for methods that compute scores in float32."""
    return [photo_id for photo_id, _ in found] == [photo_id for photo_id, _ in expected]


MIN_CANDIDATES = 32  # candidates of the binary index that are reranked exactly


@dataclass(frozen=True, slots=True)
class BenchmarkQuery:
    """A search: index `query` of the query's row, number of results, minimum score."""

    query: int
    k: int
    min_score: float | None = None


@dataclass(eq=False)
class SearchMethod(ABC):
    """A compared search method over the rows of `photo_ids`, with (q, dimension) `queries`."""

    name: ClassVar[str]
    photo_ids: Sequence[UUID]
    queries: Rows

    @property
    def memory_bytes(self) -> int:
        """Size of the index, without the page cache of files."""
        return int(self.queries[0].nbytes) * len(self.photo_ids)

    @abstractmethod
    def search(self, params: BenchmarkQuery) -> Ranking:
        """Return the ranking of a query."""

    def bytes_touched(self, _params: BenchmarkQuery) -> int:
        """Return the number of bytes of codes and rows that the search reads."""
        return int(self.queries[0].nbytes) * len(self.photo_ids)


class PlacewiseSearch(SearchMethod):
    """Placewise's search on a loaded snapshot, called directly."""

    name = "Placewise, execute_query()"

    def __init__(self, world: SyntheticMap, worker: SearchWorker, queries: Rows) -> None:
        super().__init__(world.photo_ids, queries)
        self._snapshot = worker.snapshot(world.generation_id, world.version)
        self._query_batcher = worker.query_batcher
        self._resident_bytes = worker.status().resident_bytes
        self.certificates: set[str] = set()

    @property
    def memory_bytes(self) -> int:
        return self._resident_bytes

    def search(self, params: BenchmarkQuery) -> Ranking:
        options = SearchOptions(params.k, params.min_score)
        return self.search_row(self.queries[params.query], options)

    def search_row(self, query: Rows, options: SearchOptions) -> Ranking:
        """Return the ranking of a (dimension,) row."""
        findable = self._snapshot.photos.findable
        found = execute_query(self._snapshot, query, findable, options, self._query_batcher)
        self.certificates.add(found.certificate)
        return [(hit.photo_id, hit.score) for hit in found.hits]

    def bytes_touched(self, params: BenchmarkQuery) -> int:
        with count_bytes_read() as count:
            self.search(params)
        # Without codes every row is read.
        return count.size_bytes or super().bytes_touched(params)


class PlacewiseWorker(SearchMethod):
    """The same through the search worker, which reads the query's descriptor from the store."""

    name = "Placewise, SearchWorker"

    def __init__(self, world: SyntheticMap, worker: SearchWorker, direct: PlacewiseSearch) -> None:
        super().__init__(world.photo_ids, direct.queries)
        self._world, self._worker, self._direct = world, worker, direct
        self._version = world.version
        self._keys = [world.store_query(row) for row in direct.queries]

    @property
    def memory_bytes(self) -> int:
        return self._direct.memory_bytes

    def search(self, params: BenchmarkQuery) -> Ranking:
        key = self._keys[params.query]
        request = self._world.request(key, params.k, self._version, params.min_score)
        return [(hit.photo_id, hit.score) for hit in self._worker.search(request).hits]

    def bytes_touched(self, params: BenchmarkQuery) -> int:
        return self._direct.bytes_touched(params)


@dataclass(eq=False)
class NumpySearch(SearchMethod):
    """Product of the query with all rows in one float32 array."""

    name = "NumPy, resident float32"
    rows: Rows

    def search(self, params: BenchmarkQuery) -> Ranking:
        return top_k(self.rows @ self.queries[params.query], self.photo_ids, params)


@dataclass(eq=False)
class AnyLocSearch(SearchMethod):
    """Loads every chunk for every query, as AnyLoc's similarity service does."""

    name = "np.load of every chunk"
    paths: Sequence[Path]

    @property
    def memory_bytes(self) -> int:
        return 0

    def search(self, params: BenchmarkQuery) -> Ranking:
        query = self.queries[params.query]
        scores = np.concatenate([np.dot(np.load(path), query) for path in self.paths])
        return top_k(scores, self.photo_ids, params)


@dataclass(eq=False)
class FaissFlat(SearchMethod):
    """`faiss.IndexFlatIP`; shares its rows with NumPy, to hold a single copy."""

    name = "faiss.IndexFlatIP"
    index: faiss.IndexFlat

    def search(self, params: BenchmarkQuery) -> Ranking:
        k = min(params.k, len(self.photo_ids))
        scores, rows = self.index.search(self.queries[params.query][np.newaxis], k)
        found = zip(rows[0].tolist(), scores[0].tolist(), strict=True)
        min_score = -np.inf if params.min_score is None else params.min_score
        return [(self.photo_ids[row], score) for row, score in found if score >= min_score]


@dataclass(eq=False)
class FaissPanorama(FaissFlat):
    """`faiss.IndexFlatIPPanorama`: exact, and skips the rest of rows that can't be among the best.

    It bounds a product by the first parts of a row and the norms of the others; the bytes that it
    is said to read are those of all rows.
    """

    name = "faiss.IndexFlatIPPanorama"


class FaissBinary(SearchMethod):
    """`faiss.IndexBinaryFlat` on the sign codes, with exact reranking of its candidates.

    The number of candidates that suffices for an exact result is unknown.
    """

    name = "faiss.IndexBinaryFlat + rerank"

    def __init__(
        self, photo_ids: Sequence[UUID], queries: Rows, rows: Rows, codes: SignCodes
    ) -> None:
        super().__init__(photo_ids, queries)
        words = np.concatenate(codes.levels, axis=1).view(np.uint8)
        self._index = faiss.IndexBinaryFlat(8 * words.shape[1])
        self._index.add(words)
        self._index_bytes = words.nbytes
        self._rows = rows

    @property
    def memory_bytes(self) -> int:
        return self._index_bytes

    def search(self, params: BenchmarkQuery) -> Ranking:
        query = self.queries[params.query]
        rotated = get_rotation(len(query)).rotate(query[np.newaxis])
        _, found = self._index.search(pack_signs(rotated).view(np.uint8), self._candidates(params))
        rows = found[0]
        scores = self._rows[rows].astype(np.float64) @ query.astype(np.float64)
        return top_k(scores, [self.photo_ids[row] for row in rows.tolist()], params)

    def bytes_touched(self, params: BenchmarkQuery) -> int:
        return self.memory_bytes + self._candidates(params) * self._rows.strides[0]

    def _candidates(self, params: BenchmarkQuery) -> int:
        return min(max(MIN_CANDIDATES, 3 * params.k), len(self.photo_ids))


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
