"""The search worker whose rows are in Milvus.

`MilvusWorker` holds no rows: one worker at a time writes them to a collection of the generation,
and all ask Milvus for candidates. The chunks in the object store stay the truth: cosines are
computed from their rows, and what a collection lacks is written in steps of a few seconds and named
in `missing` until then.
"""

from __future__ import annotations

import contextlib
import logging
import math
import random
import time
from collections import defaultdict, deque
from collections.abc import Collection as Values
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any
from uuid import UUID

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray
from pymilvus import MilvusClient, MilvusException

from services.search.dense_scan import ROUNDING, float32_error
from services.search.executor import SCORE_DECIMALS, round_scores
from services.search.milvus.collection import (
    MAX_LIMIT,
    MILVUS_ERRORS,
    PHOTOS,
    READ_SECONDS,
    Collection,
    engine_errors,
)
from services.search.milvus.filters import FINDABLE, filter_expression
from services.search.snapshot import Snapshot
from services.search.worker import SearchWorker
from shared.catalog.chunks import (
    Chunk,
    count_described,
    find_descriptor_rows,
    list_described,
    list_live_chunks,
    list_live_filter_values,
)
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.installation import get_or_create_installation
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoFilterValues, list_photos_changed_since, list_tags_with
from shared.config.search_settings import MAX_MILVUS_DIMENSION
from shared.config.settings import Settings
from shared.errors import Misconfigured, NotFound, Unavailable
from shared.geodesy import distance_m
from shared.search_api.photo_filter import Circle
from shared.search_api.protocol import (
    APPROXIMATE,
    EXHAUSTIVE,
    NONE,
    SearchHit,
    SearchRequest,
    SearchResponse,
    SearchStatus,
)
from shared.storage import ObjectStore
from shared.storage.chunks import Row, read_chunk, read_rows, rows_are_valid

log = logging.getLogger(__name__)

UNREADABLE = (Unavailable, NotFound, IndexError, ValueError, OSError)
NO_COLLECTION = 100  # code of an error
STEP_SECONDS = 3.0  # of writing, between two snapshots
UNKNOWN_SECONDS = 30.0  # a server that was just started may not know its collections yet
CHECK_SECONDS = 60.0  # interval of the counts of what a collection holds, and of its recall
BATCH_BYTES = 16_000_000  # of rows in one call; a message may have 64 MB
FEW_ROWS = 32  # are read one by one, not with their whole chunk
READ_THREADS = 16
MARGIN = 16  # candidates beyond k, as products of float32 may rank the last ones otherwise
GROWTH = 4  # of the number of candidates, where too few pass the filter or decide the answer
RECALL_ANSWERS = 32


@contextlib.contextmanager
def try_lock(catalog: Catalog, generation_id: UUID) -> Iterator[bool]:
    """Hold the generation's lock in the block, if it is free; yields whether it was."""
    if catalog.is_sqlite:  # has one process only
        yield True
        return
    key = generation_id.int % 2**63
    engine = catalog.engine.execution_options(isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:  # ends with the process, and the lock with it
        owned = bool(connection.scalar(sa.select(sa.func.pg_try_advisory_lock(key))))
        try:
            yield owned
        finally:
            if owned:
                connection.execute(sa.select(sa.func.pg_advisory_unlock(key)))


@dataclass(frozen=True, eq=False, kw_only=True)
class MilvusSnapshot(Snapshot):
    """What a collection holds of a generation; `chunks` is empty."""

    collection: str
    """Its name; empty where there is nothing to search."""
    written: frozenset[str]
    """Objects of the chunks whose photos are all in it."""
    live_rows: int
    row_length: int


@dataclass(slots=True)
class _Watch:
    """What a worker remembers of a generation from one look at its collection to the next."""

    check_at: float = 0.0
    unknown_since: float = math.inf
    wrong: set[str] = field(default_factory=set)
    """Keys of photos whose rows differ from those of their chunks."""
    answers: deque[tuple[MilvusSnapshot, Row, tuple[SearchHit, ...]]] = field(
        default_factory=partial(deque, maxlen=RECALL_ANSWERS)
    )
    found: float = 0.0
    expected: float = 0.0
    """Rows of chunks that answers had to have; `found` of them were there."""


class MilvusWorker(SearchWorker):
    """A search worker whose rows are in Milvus; thread-safe.

    Every call raises Unavailable (`engine_unavailable`) while Milvus does not answer.
    """

    def __init__(
        self, catalog: Catalog, store: ObjectStore, settings: Settings, **options: float
    ) -> None:
        """Connect at the first call."""
        super().__init__(catalog, store, settings, **options)
        if settings.milvus_uri is None:
            raise Misconfigured(
                "no_milvus", "SEARCH_ENGINE=milvus needs MILVUS_URI, such as http://milvus:19530."
            )
        logging.getLogger("pymilvus").setLevel(logging.CRITICAL)  # its errors are raised, too
        self._uri = settings.milvus_uri.get_secret_value()
        self._index = settings.milvus_index
        self._check_row_length = settings.check_row_length
        self._readers = ThreadPoolExecutor(READ_THREADS, "search-rows")
        self._watches: defaultdict[UUID, _Watch] = defaultdict(_Watch)
        with catalog.write() as session:
            self._prefix = f"placewise_{get_or_create_installation(session).id.hex}_"

    @cached_property
    def client(self) -> MilvusClient:
        """The connection to Milvus."""
        return MilvusClient(self._uri, timeout=READ_SECONDS)

    def status(self) -> SearchStatus:
        """Return what the collections hold."""
        watches = list(self._watches.items())
        recalls = {key: one.found / one.expected for key, one in watches if one.expected}
        return super().status().model_copy(update={"recalls": recalls})

    @engine_errors()
    def _list_stored(self) -> list[str]:
        names = self.client.list_collections(timeout=READ_SECONDS)
        return sorted(name for name in names if name.startswith(self._prefix))

    @engine_errors()
    def _remove_stored(self, stored: list[str], known: Values[UUID]) -> None:
        for ended in self._watches.keys() - known:
            del self._watches[ended]
        newest = {UUID(name.split("_")[2]): name for name in stored}
        for name in stored:
            if name not in [newest.get(one) for one in known]:
                log.info("dropping the collection %s, which is no longer used", name)
                Collection(self.client, name).drop()

    def _needs_reload(self, snapshot: Snapshot) -> bool:
        assert isinstance(snapshot, MilvusSnapshot)
        if not snapshot.collection:
            return False
        watch = self._watches[snapshot.generation_id]
        if snapshot.unwritten or self._unreadable.any_due(snapshot.missing) or watch.wrong:
            return True
        with contextlib.suppress(*MILVUS_ERRORS):  # perhaps it was dropped
            mark = Collection(self.client, snapshot.collection).read_mark()
            is_current = mark == snapshot.version
            return not is_current or time.monotonic() >= watch.check_at
        return True

    @engine_errors()
    def _sync_generation(self, generation_id: UUID, old: Snapshot | None) -> Snapshot | None:
        with try_lock(self._catalog, generation_id) as is_writer:
            return self._sync_collection(generation_id, old, is_writer)

    def _sync_collection(
        self, generation_id: UUID, old: Snapshot | None, is_writer: bool
    ) -> MilvusSnapshot | None:
        """Write what a collection lacks, for a few seconds, and return what it holds then.

        While another worker writes, this one reports what is there.
        """
        # A collection that is made again has a new name, later in the order, so that a snapshot
        # never reads another one than it was made of.
        prefix, watch = f"{self._prefix}{generation_id.hex}_", self._watches[generation_id]
        name = max((name for name in self._list_stored() if name.startswith(prefix)), default="")
        collection = Collection(self.client, name)
        marked = self._load_collection(watch, collection) if name else None
        with self._catalog.read() as session:
            generation = session.get(Generation, generation_id)
            if generation is None:
                return None
            version = session.get_one(Map, generation.map_id).version
            chunks = {chunk.object_key: chunk for chunk in list_live_chunks(session, generation_id)}
            if marked is not None and marked > version:
                marked = None  # the catalog is that of a backup
            since = version if marked is None else marked
            changes = list_photos_changed_since(session, generation.map_id, since)
            described = None
            if time.monotonic() >= watch.check_at:
                described = count_described(session, generation_id)
        fits = generation.dimension <= MAX_MILVUS_DIMENSION  # or its queries are refused
        if marked is None and is_writer and chunks and fits:
            last = int(name.split("_")[3], 16) if name else 0
            number = max(time.time_ns(), last + 1)
            name, marked = f"{prefix}{number:x}_{self._index}", version
            log.info("creating the collection %s", name)
            collection = Collection(self.client, name)
            collection.create(generation.dimension, version)
        written: frozenset[str] = frozenset()
        if marked is not None:
            if isinstance(old, MilvusSnapshot) and old.collection == name:
                written = old.written & chunks.keys()
            if is_writer:
                written -= self._apply_changes(generation_id, collection, chunks, changes)
                marked = version
                if since < version:
                    collection.write_mark(generation.dimension, version)
            written |= self._write_chunks(collection, chunks, written, is_writer)
            if is_writer and written == chunks.keys():
                written = self._find_losses(generation_id, collection, described, written)
            if described is not None:
                watch.check_at = time.monotonic() + CHECK_SECONDS
                self._measure_recall(watch, list(chunks.values()))
            # Searches wait for the time of this process's last write ("Session"), and so see what
            # any process wrote before. With "Strong" each would wait for the present time, which
            # Milvus announces five times a second.
            collection.delete(["~nothing"])
        others = chunks.keys() - written
        unwritten = frozenset(key for key in others if self._unreadable.is_due(key))
        return MilvusSnapshot(
            generation_id=generation_id,
            map_id=generation.map_id,
            version=version if not chunks or not fits else min(marked or 0, version),
            chunks=(),
            missing=tuple(sorted(others - unwritten)),
            collection="" if marked is None else name,
            written=written,
            unwritten=unwritten,
            live_rows=collection.count(FINDABLE) if marked is not None else 0,
            row_length=generation.dimension if chunks else 0,
        )

    def _load_collection(self, watch: _Watch, collection: Collection) -> int | None:
        """Return the version of the mark; None if the collection has none.

        Milvus may list a collection that it no longer has, for example one that was being dropped
        when it was killed: that is given up after a while.
        """
        try:
            marked = collection.load()
        except MilvusException as error:
            watch.unknown_since = min(watch.unknown_since, time.monotonic())
            waited = time.monotonic() - watch.unknown_since
            if error.code != NO_COLLECTION or waited < UNKNOWN_SECONDS:
                raise
            return None
        watch.unknown_since = math.inf
        return marked

    def _apply_changes(
        self,
        generation_id: UUID,
        collection: Collection,
        chunks: dict[str, Chunk],
        changes: Sequence[PhotoFilterValues],
    ) -> set[str]:
        """Write the changed photos anew; returns the chunks that can't be read for that."""
        kept = {photo.photo_id: photo for photo in changes if photo.deleted_at is None}
        collection.delete([photo.photo_id.hex for photo in changes if photo.deleted_at])
        with self._catalog.read() as session:
            located = find_descriptor_rows(session, generation_id, list(kept))
        lost = set()
        for key, found in located.items():
            photos = [(row, kept[photo_id]) for row, photo_id in found]
            if key not in chunks or not self._write_photos(collection, chunks[key], photos):
                collection.delete([photo.photo_id.hex for _, photo in photos])
                lost.add(key)
        return lost

    def _write_chunks(
        self,
        collection: Collection,
        chunks: dict[str, Chunk],
        written: Values[str],
        is_writer: bool,
    ) -> set[str]:
        """Return which of the other chunks are there, after writing some if this is the writer."""
        ends_at = time.monotonic() + STEP_SECONDS
        new = set()
        # The newest first: a query may wait for a photo that was just published.
        waiting = sorted(chunks.keys() - written, key=lambda key: chunks[key].id, reverse=True)
        for key in waiting:
            lacking = self._find_lacking(collection, chunks[key])
            may_write = is_writer and self._unreadable.is_due(key)
            if lacking and may_write and self._write_photos(collection, chunks[key], lacking):
                lacking = []
            if lacking == []:
                new.add(key)
            if time.monotonic() >= ends_at:
                break
        if len(new) < len(waiting):
            count = len(written) + len(new)
            log.info("%s: %d of %d chunks are written", collection.name, count, len(chunks))
        return new

    def _find_lacking(
        self, collection: Collection, chunk: Chunk
    ) -> list[tuple[int, PhotoFilterValues]] | None:
        """Return the rows of a chunk, with their live photos, that are not in the collection.

        None if it was merged since the chunks were listed: its photos are in another one then.
        """
        is_live = sa.select(Chunk.id).where(Chunk.id == chunk.id, Chunk.superseded_at.is_(None))
        with self._catalog.read() as session:
            if session.scalar(is_live) is None:
                return None
            values = list_live_filter_values(session, chunk.id)
        photos = [(row, photo) for row, photo in values if photo.deleted_at is None]
        there = set(collection.get([photo.photo_id.hex for _, photo in photos], "photo"))
        return [(row, photo) for row, photo in photos if photo.photo_id.hex not in there]

    def _write_photos(
        self, collection: Collection, chunk: Chunk, photos: Sequence[tuple[int, PhotoFilterValues]]
    ) -> bool:
        """Write rows of a chunk with the values of their photos; False if it can't be read."""
        numbers = [row for row, _ in photos]
        size = max(1, BATCH_BYTES * chunk.rows // chunk.size_bytes)
        try:
            if len(photos) <= FEW_ROWS:
                rows = self._read_rows(chunk.object_key, numbers)
            else:
                stored = read_chunk(self._store, chunk.object_key, chunk.sha256)
                rows = stored[numbers].astype(np.float32)
            collection.write([(p, row) for (_, p), row in zip(photos, rows, strict=True)], size)
        except UNREADABLE as error:
            self._unreadable.failed(chunk.object_key, error)
            return False
        self._unreadable.succeeded(chunk.object_key)
        return True

    def _find_losses(
        self,
        generation_id: UUID,
        collection: Collection,
        described: int | None,
        written: frozenset[str],
    ) -> frozenset[str]:
        """Delete rows that no chunk has; returns `written`, or none if rows may have been lost."""
        watch = self._watches[generation_id]
        others, watch.wrong = watch.wrong, set()
        if not others and (described is None or collection.count(PHOTOS) == described):
            return written
        log.warning("%s does not hold what the chunks do: its photos are compared", collection.name)
        with self._catalog.read() as session:
            photos = {photo_id.hex for photo_id in list_described(session, generation_id)}
        collection.delete(sorted(others | collection.find_others(photos)))
        return frozenset()

    def _measure_recall(self, watch: _Watch, chunks: Sequence[Chunk]) -> None:
        """Compare recent answers with a random chunk, whose more similar rows have to be there."""
        if not watch.answers:
            return
        (chunk,) = random.sample(chunks, 1)
        try:
            rows = read_chunk(self._store, chunk.object_key, chunk.sha256).astype(np.float32)
        except UNREADABLE as error:
            log.warning("%s is left out of the recall: %s", chunk.object_key, error)
            return
        with self._catalog.read() as session:
            values = list_live_filter_values(session, chunk.id)
        photos = {row: photo.photo_id for row, photo in values if photo.findable}
        watch.found, watch.expected = 0.9 * watch.found, 0.9 * watch.expected
        while watch.answers:
            snapshot, vector, hits = watch.answers.popleft()
            if chunk.object_key in snapshot.written:
                least = hits[-1].score + 2 * float32_error(rows.shape[1])
                better = np.flatnonzero(rows @ vector > least).tolist()
                expected = {photos[row] for row in better if row in photos}
                watch.expected += len(expected)
                watch.found += len(expected & {hit.photo_id for hit in hits})

    @engine_errors()
    def _find_rows(self, snapshot: Snapshot, query: Row, request: SearchRequest) -> SearchResponse:
        """Return the most similar rows.

        No row that Milvus leaves out has a larger product than the last one that it returns. Both
        are off by at most an error of float32: an answer whose k-th cosine is larger than that
        product by both errors is complete.
        """
        assert isinstance(snapshot, MilvusSnapshot)
        self._check_row_length(snapshot.row_length)
        with self._catalog.read() as session:
            condition = filter_expression(
                request.photos,
                request.exclude,
                lambda part: list_tags_with(session, snapshot.map_id, part),
            )
        length = float(np.linalg.norm(query.astype(np.float64)))
        unit = (query / (length or 1.0)).astype(np.float32)
        error = float32_error(len(query)) + 2 * ROUNDING + 10.0**-SCORE_DECIMALS
        collection = Collection(self.client, snapshot.collection)
        is_exact = not snapshot.collection or collection.is_exact
        limit = min(request.k + MARGIN, MAX_LIMIT)
        products: dict[UUID, float] = {}
        scores: dict[UUID, float] = {}
        missing = {*snapshot.missing, *snapshot.unwritten}
        hits: tuple[SearchHit, ...] = ()
        complete = not snapshot.collection or not length
        while not complete:
            found = collection.search(unit, limit, condition)
            expected = snapshot.live_rows if condition == FINDABLE else 1
            if len(found) < min(limit, expected) and collection.read_mark() is None:
                raise Unavailable("engine_unavailable", f"{collection.name} has lost its rows.")
            near = self._in_circle(found, request.photos.near) - products.keys()
            products |= {UUID(hit["entity"]["photo"]): hit["distance"] for hit in found}
            exact, unreadable = self._score(snapshot.generation_id, list(near), query)
            scores |= exact
            missing |= unreadable
            best = sorted((-score, photo_id) for photo_id, score in scores.items())[: request.k]
            hits = tuple(SearchHit(photo_id=photo_id, score=-score) for score, photo_id in best)
            enough = len(hits) == request.k
            least = found[-1]["distance"] + 2 * error if found else -math.inf
            complete = len(found) < limit or (enough and hits[-1].score > least)
            if limit == MAX_LIMIT or (enough and not is_exact):
                break
            limit = min(GROWTH * limit, MAX_LIMIT)
        certificate = EXHAUSTIVE if is_exact and complete else APPROXIMATE
        watch = self._watches[snapshot.generation_id]
        wrong = {id_.hex for id_, score in scores.items() if abs(products[id_] - score) > error}
        watch.wrong |= wrong
        if wrong or missing:
            certificate = NONE
        elif not is_exact and len(hits) == request.k and condition == FINDABLE:
            watch.answers.append((snapshot, unit, hits))
        return SearchResponse(
            hits=hits,
            certificate=certificate,
            rows_scanned=snapshot.live_rows,
            rows_reranked=len(scores),
            snapshot_version=snapshot.version,
            missing=tuple(sorted(missing)),
            filling=bool(snapshot.unwritten),
        )

    @staticmethod
    def _in_circle(hits: Sequence[Any], circle: Circle | None) -> set[UUID]:
        """Return the photos of hits, and only those in the circle, not in its bounding box."""

        def is_inside(photo: Any) -> bool:
            return circle is None or circle.radius_m >= distance_m(
                circle.latitude, circle.longitude, photo["latitude"], photo["longitude"]
            )

        return {UUID(hit["entity"]["photo"]) for hit in hits if is_inside(hit["entity"])}

    def _score(
        self, generation_id: UUID, photo_ids: Sequence[UUID], query: Row
    ) -> tuple[dict[UUID, float], set[str]]:
        """Return the float64 cosines of photos, and the chunks that can't be read."""
        with self._catalog.read() as session:
            located = find_descriptor_rows(session, generation_id, photo_ids)
        exact = query.astype(np.float64)
        exact /= np.sqrt(exact @ exact)

        def score(key: str) -> dict[UUID, float]:
            numbers, photos = zip(*located[key], strict=True)
            try:
                rows = self._read_rows(key, numbers)
            except UNREADABLE as error:
                log.warning("rows of %s can't be read: %s", key, error)
                return {}
            products = round_scores(np.vecdot(rows.astype(np.float64), exact))
            return dict(zip(photos, products.tolist(), strict=True))

        scored = dict(zip(located, self._readers.map(score, located), strict=True))
        scores = {photo_id: one for found in scored.values() for photo_id, one in found.items()}
        return scores, {key for key, found in scored.items() if not found}

    def _read_rows(self, key: str, numbers: Sequence[int]) -> NDArray[np.float32]:
        """Read rows of a chunk, (n, dimension); raises one of UNREADABLE."""
        rows = read_rows(self._store, key, numbers)
        if not rows_are_valid(rows).all():
            raise ValueError(f"rows of {key} are no unit vectors")
        return rows
