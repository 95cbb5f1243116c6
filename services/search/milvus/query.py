"""Queries of a collection: candidates of Milvus, ranked by the rows of their chunks."""

from __future__ import annotations

import logging
import random
import threading
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from uuid import UUID

import numpy as np

from services.search.chunk_loader import ChunkLoader
from services.search.dense_scan import ROUNDING, float32_error
from services.search.executor import SCORE_DECIMALS, round_scores
from services.search.milvus.collections import MAX_LIMIT, EngineHit, MilvusCollection
from services.search.milvus.expressions import FINDABLE, filter_expression
from shared.catalog.chunks import Chunk, find_descriptor_rows, list_live_filter_values
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.photos import list_tags_with
from shared.config.settings import Settings
from shared.errors import NotFound, Unavailable
from shared.geodesy import distance_m
from shared.search_api.photo_filter import Circle
from shared.search_api.protocol import (
    APPROXIMATE,
    EXHAUSTIVE,
    NONE,
    IndexPart,
    LoadedGeneration,
    SearchHit,
    SearchRequest,
    SearchResponse,
)
from shared.storage import ObjectStore
from shared.storage.chunks import Row, read_rows, rows_are_valid

log = logging.getLogger(__name__)

MARGIN = 16  # candidates beyond k, as products of float32 may rank the last ones otherwise
GROWTH = 4  # of the number of candidates, where too few pass the filter or decide the answer
READ_THREADS = 16
RECALL_SECONDS = 60.0
RECALL_QUERIES = 32
RECALL_CHUNKS = 10
MAX_COUNTED = 10_000  # rows, after which earlier ones count half


@dataclass(frozen=True, eq=False)
class EngineSnapshot:
    """What a collection holds of a generation at `version` of its map."""

    generation_id: UUID
    version: int
    collection: MilvusCollection | None
    """None where there is nothing to search yet."""
    written: frozenset[UUID]
    """Chunks whose photos are all in the collection."""
    missing: tuple[str, ...]
    """Objects of the other chunks."""
    unreadable: frozenset[str]
    """Those that can't be read; the others are still to be written."""
    live_rows: int
    dimension: int
    disk_full: bool = False
    parts: tuple[IndexPart, ...] = ()

    @property
    def held(self) -> LoadedGeneration:
        """The generation as `SearchStatus` reports it."""
        return LoadedGeneration(rows=self.live_rows, dimension=self.dimension, parts=())

    def read_row(self, object_key: str, row: int) -> Row | None:
        """No rows are held here."""
        return None


@dataclass(frozen=True, slots=True, eq=False)
class _AnsweredQuery:
    """A query without a filter, whose answer is compared with the rows of a chunk."""

    vector: Row
    photo_ids: frozenset[UUID]
    last_score: float
    chunks: frozenset[UUID]


@dataclass(slots=True)
class _Recall:
    """How many of the rows that belong into the answers were in them."""

    found: int = 0
    expected: int = 0


class MilvusQuery:
    """Answers queries; thread-safe."""

    def __init__(self, catalog: Catalog, store: ObjectStore, settings: Settings) -> None:
        self._settings = settings
        self._catalog = catalog
        self._store = store
        self._is_exact = settings.milvus_index == "FLAT"
        self._readers = ThreadPoolExecutor(READ_THREADS, "search-rows")
        self._lock = threading.Lock()
        self._suspects: dict[UUID, set[UUID]] = {}
        self._recent: dict[UUID, deque[_AnsweredQuery]] = {}
        self._counts: dict[UUID, _Recall] = {}
        self._recall_due = 0.0

    @property
    def recalls(self) -> dict[UUID, float]:
        """Share of the rows of recent answers that an approximate index found, by generation."""
        counts = self._counts.items()
        return {key: count.found / count.expected for key, count in counts if count.expected}

    def has_suspects(self, generation_id: UUID) -> bool:
        """Whether rows of the generation differ from those of the chunks."""
        return generation_id in self._suspects

    def take_suspects(self, generation_id: UUID) -> set[UUID]:
        """Return the photos whose rows differ from those of the chunks, and forget them."""
        with self._lock:
            return self._suspects.pop(generation_id, set())

    def search(
        self, snapshot: EngineSnapshot, query: Row, request: SearchRequest
    ) -> SearchResponse:
        """Return the k best photos.

        No row that Milvus leaves out has a larger product than the last one that it returns. Both
        are off by at most an error of float32: an answer whose k-th cosine is larger than that
        product by both errors is complete.
        """
        self._settings.check_row_length(snapshot.dimension)
        collection = snapshot.collection
        if collection is None or not query.any():
            return _response(snapshot, [], EXHAUSTIVE, 0, snapshot.missing)
        error = float32_error(len(query)) + 2 * ROUNDING + 10.0**-SCORE_DECIMALS
        unit = (query / np.linalg.norm(query.astype(np.float64))).astype(np.float32)
        condition = filter_expression(
            request.photos, request.exclude, lambda part: self._tags_with(snapshot, part)
        )
        scores: dict[UUID, float] = {}
        seen: set[UUID] = set()
        unreadable: set[str] = set()
        limit = min(request.k + MARGIN, MAX_LIMIT)
        while True:
            found = collection.search(unit, limit, condition)
            near = [hit for hit in found if hit.photo_id not in seen]
            seen |= {hit.photo_id for hit in near}
            if circle := request.photos.near:
                near = [hit for hit in near if is_in_circle(hit, circle)]
            exact, unread = self._score(snapshot.generation_id, near, query)
            scores |= exact
            unreadable |= unread
            ranked = sorted((-score, photo_id) for photo_id, score in scores.items())[: request.k]
            enough = len(ranked) == request.k
            complete = len(found) < limit or (
                enough and -ranked[-1][0] > found[-1].product + 2 * error
            )
            if complete or (enough and not self._is_exact) or limit == MAX_LIMIT:
                break
            limit = min(GROWTH * limit, MAX_LIMIT)
        products = {hit.photo_id: hit.product for hit in found}
        wrong = {p for p, score in scores.items() if abs(products.get(p, score) - score) > error}
        if wrong:
            with self._lock:
                self._suspects.setdefault(snapshot.generation_id, set()).update(wrong)
        missing = tuple(dict.fromkeys([*snapshot.missing, *sorted(unreadable)]))
        hits = [SearchHit(photo_id=photo_id, score=-score) for score, photo_id in ranked]
        certificate = EXHAUSTIVE if self._is_exact and complete else APPROXIMATE
        if wrong or missing:
            certificate = NONE
        elif certificate == APPROXIMATE and enough and condition == FINDABLE:
            self._remember(snapshot, unit, hits)
        return _response(snapshot, hits, certificate, len(scores), missing)

    def _tags_with(self, snapshot: EngineSnapshot, part: str) -> list[str]:
        with self._catalog.read() as session:
            map_id = session.get_one(Generation, snapshot.generation_id).map_id
            return list_tags_with(session, map_id, part)

    def _score(
        self, generation_id: UUID, hits: Sequence[EngineHit], query: Row
    ) -> tuple[dict[UUID, float], set[str]]:
        """Return the float64 cosines of photos, and the chunks that can't be read."""
        with self._catalog.read() as session:
            located = find_descriptor_rows(session, generation_id, [hit.photo_id for hit in hits])
        exact = query.astype(np.float64)
        exact /= np.sqrt(exact @ exact)

        def score(key: str) -> dict[UUID, float] | None:
            numbers, photo_ids = zip(*located[key], strict=True)
            try:
                rows = read_rows(self._store, key, numbers)
            except (NotFound, IndexError, ValueError, Unavailable) as error:
                log.warning("rows of %s can't be read: %s", key, error)
                return None
            if not rows_are_valid(rows).all():
                return None
            products = round_scores(np.vecdot(rows.astype(np.float64), exact))
            return dict(zip(photo_ids, products.tolist(), strict=True))

        scores: dict[UUID, float] = {}
        unreadable = set()
        for key, scored in zip(located, self._readers.map(score, located), strict=True):
            if scored is None:
                unreadable.add(key)
            else:
                scores |= scored
        return scores, unreadable

    def _remember(self, snapshot: EngineSnapshot, vector: Row, hits: Sequence[SearchHit]) -> None:
        answered = _AnsweredQuery(
            vector, frozenset(hit.photo_id for hit in hits), hits[-1].score, snapshot.written
        )
        with self._lock:
            recent = self._recent.setdefault(snapshot.generation_id, deque(maxlen=RECALL_QUERIES))
            recent.append(answered)

    def measure_recall(
        self, generation_id: UUID, chunks: Sequence[Chunk], loader: ChunkLoader
    ) -> None:
        """Compare recent answers with the rows of random chunks, once a minute.

        What of a chunk is more similar than an answer's last photo has to be in the answer.
        """
        if generation_id not in self._recent or time.monotonic() < self._recall_due:
            return
        self._recall_due = time.monotonic() + RECALL_SECONDS
        with self._lock:
            answers = self._recent.pop(generation_id)
        count = self._counts.setdefault(generation_id, _Recall())
        for chunk in random.sample(chunks, min(RECALL_CHUNKS, len(chunks))):
            try:
                rows = loader.load_rows(chunk).rows.astype(np.float32)
            except (Unavailable, NotFound, ValueError, OSError) as unreadable:
                log.warning("%s is left out of the recall: %s", chunk.object_key, unreadable)
                continue
            with self._catalog.read() as session:
                photos = {
                    row: photo.photo_id
                    for row, photo in list_live_filter_values(session, chunk.id)
                    if photo.findable
                }
            for answer in answers:
                if chunk.id in answer.chunks:
                    least = answer.last_score + 2 * float32_error(rows.shape[1])
                    better = np.flatnonzero(rows @ answer.vector > least).tolist()
                    expected = [photos[row] for row in better if row in photos]
                    count.expected += len(expected)
                    count.found += len(answer.photo_ids.intersection(expected))
        if count.expected > MAX_COUNTED:
            count.found, count.expected = count.found // 2, count.expected // 2


def is_in_circle(hit: EngineHit, circle: Circle) -> bool:
    """Whether the photo is within the circle, not only in its bounding box."""
    away = distance_m(circle.latitude, circle.longitude, hit.latitude, hit.longitude)
    return away <= circle.radius_m


def _response(
    snapshot: EngineSnapshot,
    hits: Sequence[SearchHit],
    certificate: str,
    compared: int,
    missing: tuple[str, ...],
) -> SearchResponse:
    return SearchResponse(
        hits=tuple(hits),
        certificate=NONE if missing else certificate,
        rows_scanned=snapshot.live_rows,
        rows_reranked=compared,
        snapshot_version=snapshot.version,
        missing=missing,
        filling=bool(set(snapshot.missing) - snapshot.unreadable),
    )
