"""`MilvusIndex`: keeps collections in step with the catalog, and searches them.

The chunks in the object store are the truth. What a collection lacks is written in steps of a few
seconds, by whichever worker holds the generation's lock, and is named in `missing` until then. The
cosines of an answer are computed from the rows of the chunks.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from uuid import UUID

import numpy as np

from services.search.chunk_loader import ChunkLoader
from services.search.milvus.collections import (
    BATCH_BYTES,
    IDS_PER_CALL,
    MARK,
    CollectionGone,
    Marks,
    Milvus,
    MilvusCollection,
    Row,
)
from services.search.milvus.expressions import filter_columns
from services.search.milvus.query import EngineSnapshot, MilvusQuery
from shared.catalog.chunks import (
    Chunk,
    count_described,
    find_descriptor_rows,
    list_described,
    list_live_chunks,
    list_live_filter_values,
)
from shared.catalog.database.locks import hold_lock
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.installation import get_or_create_installation
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoFilterValues, list_photos_changed_since
from shared.config.search_settings import MAX_MILVUS_DIMENSION
from shared.config.settings import Settings
from shared.errors import NotFound, Unavailable
from shared.search_api.protocol import SearchRequest, SearchResponse
from shared.storage import ObjectStore
from shared.storage.chunks import Row as QueryRow
from shared.storage.read_retries import ReadRetries

log = logging.getLogger(__name__)

LOCK_SECONDS = 1.0  # wait for the worker that is writing the same generation
STEP_SECONDS = 3.0  # of writing, between two snapshots
GONE_SECONDS = 30.0  # a server that was just started may not know its collections yet
COUNT_SECONDS = 60.0  # interval of the counts of what a collection holds


@dataclass(frozen=True, slots=True)
class _Generation:
    """What the catalog says about a generation."""

    version: int
    dimension: int
    chunks: Sequence[Chunk]
    changes: Sequence[PhotoFilterValues]
    described: int | None
    """Live photos with a descriptor; None if they were not counted."""


class MilvusIndex:
    """The rows of all generations in Milvus; thread-safe, one sync of a generation at a time."""

    changes_alone = True

    def __init__(
        self, catalog: Catalog, store: ObjectStore, settings: Settings, unreadable: ReadRetries
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._folder = settings.search_cache_folder
        self._unreadable = unreadable
        self._milvus = Milvus(settings)
        self._count_due: dict[UUID, float] = {}
        self._gone: dict[UUID, float] = {}  # by generation: monotonic seconds of the first failure
        self._query = MilvusQuery(catalog, store, settings)

    @cached_property
    def _prefix(self) -> str:
        """Begins the names of this installation's collections."""
        with self._catalog.write() as session:
            return f"placewise_{get_or_create_installation(session).id.hex}_"

    @property
    def recalls(self) -> dict[UUID, float]:
        """Measured recall of an approximate index, by generation."""
        return self._query.recalls

    def list_held(self) -> list[str]:
        """Return the collections of this installation."""
        return self._milvus.names(self._prefix)

    def remove_others(self, held: Iterable[str], generation_ids: Collection[UUID]) -> None:
        """Drop those of these collections that belong to no generation of these."""
        known = {generation_id.hex for generation_id in generation_ids}
        newest = {name.rpartition("_")[0]: name for name in held}
        for name in held:
            of_generation = name.rpartition("_")[0]
            ended = of_generation.removeprefix(self._prefix) not in known
            if ended or newest[of_generation] != name:
                log.info("dropping the collection %s, which is no longer used", name)
                with contextlib.suppress(CollectionGone):
                    self._milvus.drop(name)

    def needs_sync(self, snapshot: EngineSnapshot) -> bool:
        """Whether something is still to be written, or the collection is not as it was."""
        generation_id = snapshot.generation_id
        if snapshot.collection is None:
            return False
        if self._unreadable.any_due(snapshot.missing) or self._query.has_suspects(generation_id):
            return True
        if time.monotonic() >= self._count_due.get(generation_id, 0.0):
            return True
        try:
            return snapshot.collection.marked_version() != snapshot.version
        except Unavailable:  # perhaps it was dropped
            return True

    def search(
        self, snapshot: EngineSnapshot, query: QueryRow, request: SearchRequest
    ) -> SearchResponse:
        """Return the most similar rows."""
        return self._query.search(snapshot, query, request)

    def sync(self, generation_id: UUID, old: EngineSnapshot | None) -> EngineSnapshot | None:
        """Write what a collection lacks, for a few seconds, and return what it holds then.

        While another worker writes, this one reports what is there. Milvus may list a collection
        that it no longer has, for example one that was being dropped when it was killed.
        """
        try:
            snapshot = self._sync(generation_id)
        except CollectionGone:
            self._gone.setdefault(generation_id, time.monotonic())
            raise
        self._gone.pop(generation_id, None)
        return snapshot

    def _sync(self, generation_id: UUID) -> EngineSnapshot | None:
        prefix = f"{self._prefix}{generation_id.hex}_"
        with hold_lock(self._catalog, generation_id, LOCK_SECONDS) as is_writer:
            collection = self._milvus.open(prefix)
            is_gone = time.monotonic() - self._gone.get(generation_id, math.inf) >= GONE_SECONDS
            marks = collection.marks() if collection and not (is_gone and is_writer) else None
            if collection and marks is None and is_writer:
                log.warning("another collection takes the place of %s", collection.name)
                self._gone.pop(generation_id, None)
                collection = None
            state = self._read_catalog(generation_id, marks)
            if state is None:
                return None
            fits = state.dimension <= MAX_MILVUS_DIMENSION  # or its queries are refused
            if collection is None and is_writer and state.chunks and fits:
                log.info("creating a collection for generation %s", generation_id)
                collection = self._milvus.create(prefix, state.dimension, state.version)
                marks = Marks(state.version, frozenset())
            if collection and marks and is_writer:
                marks = self._write(generation_id, collection, marks, state)
        if collection and marks:
            collection.settle()
        version = state.version if is_writer or marks is None else min(marks.version, state.version)
        if marks is None and state.chunks and fits:
            version = 0
        written = marks.chunks if marks else frozenset()
        missing = [chunk.object_key for chunk in state.chunks if chunk.id not in written]
        self._query.measure_recall(generation_id, state.chunks, self._loader(generation_id))
        return EngineSnapshot(
            generation_id=generation_id,
            version=version,
            missing=tuple(missing),
            unreadable=frozenset(key for key in missing if self._unreadable.has_failed(key)),
            collection=collection if marks else None,
            written=written,
            live_rows=collection.count("findable == true") if collection else 0,
            dimension=state.dimension if state.chunks else 0,
        )

    def _loader(self, generation_id: UUID) -> ChunkLoader:
        return ChunkLoader(self._store, self._folder / str(generation_id))

    def _read_catalog(self, generation_id: UUID, marks: Marks | None) -> _Generation | None:
        with self._catalog.read() as session:
            generation = session.get(Generation, generation_id)
            if generation is None:
                return None
            version = session.get_one(Map, generation.map_id).version
            since = marks.version if marks else version
            chunks = list_live_chunks(session, generation_id)
            counts = (
                marks is not None
                and marks.chunks.issuperset(chunk.id for chunk in chunks)
                and time.monotonic() >= self._count_due.get(generation_id, 0.0)
            )
            return _Generation(
                version,
                generation.dimension,
                chunks,
                list_photos_changed_since(session, generation.map_id, since),
                count_described(session, generation_id) if counts else None,
            )

    def _write(
        self, generation_id: UUID, collection: MilvusCollection, marks: Marks, state: _Generation
    ) -> Marks:
        """Write changes, then chunks until the time is over; return what is written."""
        changes = {photo.photo_id: photo for photo in state.changes}
        self._apply_changes(collection, changes)
        if marks.version < state.version:
            collection.mark_version(state.version)
        live = {chunk.id: chunk for chunk in state.chunks}
        collection.unmark_chunks(marks.chunks - live.keys())
        written = {id_ for id_ in marks.chunks if id_ in live}
        if wrong := self._query.take_suspects(generation_id):
            log.warning("%d rows in Milvus differ from their chunks", len(wrong))
            collection.delete(wrong)
            written -= self._find_losses(generation_id, collection, state)
        elif state.described is not None:
            written -= self._find_losses(generation_id, collection, state)
        ends_at = time.monotonic() + STEP_SECONDS
        # The newest first: a query may wait for a photo that was just published.
        for chunk_id in sorted(live.keys() - written, reverse=True):
            if not self._unreadable.is_due(live[chunk_id].object_key):
                continue
            if self._write_chunk(generation_id, collection, live[chunk_id]):
                written.add(chunk_id)
            if time.monotonic() >= ends_at:
                break
        if written != live.keys():
            log.info(
                "%d of %d rows of generation %s are in Milvus",
                sum(chunk.rows for chunk in state.chunks if chunk.id in written),
                sum(chunk.rows for chunk in state.chunks),
                generation_id,
            )
        return Marks(state.version, frozenset(written))

    @staticmethod
    def _apply_changes(
        collection: MilvusCollection, changes: Mapping[UUID, PhotoFilterValues]
    ) -> None:
        """Write changed values beside the vectors that are there, and delete deleted photos."""
        collection.delete([id_ for id_, photo in changes.items() if photo.deleted_at is not None])
        kept = [id_ for id_, photo in changes.items() if photo.deleted_at is None]
        vectors = collection.vectors(kept)
        rows = ({**filter_columns(changes[id_]), "vector": vector} for id_, vector in vectors)
        for batch in _batches(rows):
            collection.put(batch)

    def _write_chunk(self, generation_id: UUID, collection: MilvusCollection, chunk: Chunk) -> bool:
        """Write the rows of a chunk that are not there; return False if it can't be read."""
        loader = self._loader(generation_id)
        try:
            stored = loader.load_rows(chunk).rows
        except (Unavailable, NotFound, ValueError, OSError) as error:
            self._unreadable.failed(chunk.object_key, error)
            return False
        finally:
            loader.evict_except([])  # what is mapped stays readable
        self._unreadable.succeeded(chunk.object_key)
        with self._catalog.read() as session:
            photos = list_live_filter_values(session, chunk.id)
        held = collection.held([photo.photo_id for _, photo in photos])
        rows = (
            {**filter_columns(photo), "vector": stored[row].astype(np.float32)}
            for row, photo in photos
            if photo.photo_id not in held
        )
        for batch in _batches(rows):
            collection.put(batch)
        collection.mark_chunk(chunk.id)
        return True

    def _find_losses(
        self, generation_id: UUID, collection: MilvusCollection, state: _Generation
    ) -> set[UUID]:
        """Compare the photos, one by one, with those of the catalog if their number differs.

        Rows of other photos are deleted. Returns the chunks with photos that have no row.
        """
        self._count_due[generation_id] = time.monotonic() + COUNT_SECONDS
        if collection.count(f'photo < "{MARK}"') == state.described:
            return set()
        there = collection.all_photos()
        with self._catalog.read() as session:
            described = list_described(session, generation_id)
            lost = find_descriptor_rows(session, generation_id, list(described - there))
        collection.delete(there - described)
        chunks = {chunk.id for chunk in state.chunks if chunk.object_key in lost}
        collection.unmark_chunks(chunks)
        log.warning(
            "Milvus lacked %d rows of generation %s, which are written again, and had %d too many",
            len(described - there),
            generation_id,
            len(there - described),
        )
        return chunks


def _batches(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Split rows into calls."""
    batch: list[Row] = []
    size_bytes = 0
    for row in rows:
        batch.append(row)
        size_bytes += row["vector"].nbytes + len(row["place"]) + sum(map(len, row["tags"]))
        if size_bytes >= BATCH_BYTES or len(batch) == IDS_PER_CALL:
            yield batch
            batch, size_bytes = [], 0
    if batch:
        yield batch
