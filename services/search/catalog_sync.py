"""From one version of a map to the next: load what is new, forget what is gone.

How far behind a worker's snapshots are, told without asking the catalog.

A worker that is stuck in loading, or that can't reach the catalog, has to notice it by itself:
what counts is when a snapshot was last known to be level with its map.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID

from sqlalchemy import select

from services.search.chunk_loader import (
    ChunkLoader,
    LoadedChunk,
    generation_loader,
    hold_in_memory,
    memory_parts,
)
from services.search.photo_columns import PhotoColumns
from services.search.residency import MemoryBudget
from services.search.snapshot import Snapshot
from shared.catalog.chunks import list_live_chunks, list_live_filter_values
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoFilterValues, list_photos_changed_since
from shared.catalog.session import Catalog
from shared.config.shards import SINGLE_SHARD, Shard
from shared.errors import NotFound, Unavailable
from shared.search_api.protocol import IndexPart, ReplicationLag
from shared.storage import ObjectStore
from shared.storage.chunks import CODED_DIMENSION
from shared.storage.read_retries import ReadRetries

if TYPE_CHECKING:
    from shared.codes.int8_codes import Int8Codes


log = logging.getLogger(__name__)

MIN_CODED_BYTES = 64_000_000  # of rows: less is compared faster as it is

SYNCED_STATES = (GenerationState.ACTIVE, GenerationState.BUILDING)


@dataclass(frozen=True, slots=True)
class GenerationVersion:
    """A generation to follow: `version` is its map's, now."""

    version: int
    state: GenerationState


def read_generation_versions(catalog: Catalog) -> dict[UUID, GenerationVersion]:
    """Every generation to follow."""
    with catalog.read() as session:
        found = session.execute(
            select(Generation.id, Map.version, Generation.state)
            .join(Map, Map.id == Generation.map_id)
            .where(Generation.state.in_(SYNCED_STATES), Map.deleted_at.is_(None))
        )
        return {
            id_: GenerationVersion(version, GenerationState(state)) for id_, version, state in found
        }


def sync_snapshot(
    catalog: Catalog,
    store: ObjectStore,
    folder: Path,
    memory_budget: MemoryBudget,
    generation_id: UUID,
    old: Snapshot | None,
    unreadable: ReadRetries,
    shard: Shard = SINGLE_SHARD,
) -> Snapshot | None:
    """The shard's part of the generation as it is now, reusing what `old` has loaded; None when
    the generation is gone.

    Reads the catalog in one consistent transaction. A chunk that can't be read, or whose hash
    differs, is named in `missing`, and the rest is served; it is read again once `unreadable` says
    that it is due. Files are kept below `folder`.
    """
    loader = generation_loader(store, folder, generation_id)
    with catalog.read() as session:
        generation = session.get(Generation, generation_id)
        if generation is None:
            memory_budget.release_generation(generation_id)
            return None
        version = session.get_one(Map, generation.map_id).version
        chunks = [c for c in list_live_chunks(session, generation_id) if shard.owns(c.slot)]
        known = {c.chunk_id: c for c in old.chunks if not c.was_changed()} if old else {}
        changed = list_photos_changed_since(session, generation.map_id, old.version) if old else []
        facts_of = {
            chunk.id: list_live_filter_values(session, chunk.id)
            for chunk in chunks
            if chunk.id not in known and unreadable.is_due(chunk.object_key)
        }
    changes = {photo.photo_id: photo for photo in changed}
    loaded: list[LoadedChunk] = []
    missing: list[str] = []
    for chunk in chunks:
        if chunk.id in known:
            loaded.append(_apply_photo_changes(known[chunk.id], changes))
            continue
        if chunk.id not in facts_of:
            missing.append(chunk.object_key)
            continue
        try:
            stored = loader.load_rows(chunk)
        except (Unavailable, NotFound, ValueError, OSError) as error:
            unreadable.failed(chunk.object_key, error)
            missing.append(chunk.object_key)
            continue
        unreadable.succeeded(chunk.object_key)
        photos = PhotoColumns.of(len(stored.rows), facts_of[chunk.id])
        loaded.append(LoadedChunk(chunk.id, chunk.object_key, stored.rows, photos, stored=stored))
    large = sum(chunk.rows.nbytes for chunk in loaded) >= MIN_CODED_BYTES
    if large:
        loaded = _with_codes(loader, loaded)
        _compile_kernels(loaded)
    loader.evict_except(loaded)
    middle = bool(loaded) and loaded[0].rows.shape[1] < CODED_DIMENSION
    if (middle and large) or (old is not None and old.has_int8_codes):
        loaded = _attach_int8_to_all(loader, loaded)
    return _apply_memory_budget(
        memory_budget,
        Snapshot(
            generation_id=generation_id,
            map_id=generation.map_id,
            version=version,
            chunks=tuple(loaded),
            missing=tuple(missing),
        ),
    )


def with_int8_codes(
    store: ObjectStore,
    folder: Path,
    memory_budget: MemoryBudget,
    old: Snapshot,
    made: Mapping[UUID, Int8Codes],
) -> Snapshot:
    """The same snapshot with int8 codes of every chunk: those that were made, by chunk id, and
    others that are made now."""
    loader = generation_loader(store, folder, old.generation_id)
    return _apply_memory_budget(
        memory_budget, replace(old, chunks=tuple(_attach_int8(loader, c, made) for c in old.chunks))
    )


def _apply_memory_budget(memory: MemoryBudget, snapshot: Snapshot) -> Snapshot:
    """The snapshot with what the budget allows in memory."""
    parts = memory_parts(snapshot.chunks)
    held = memory.allocate(snapshot.generation_id, [size_bytes for _, size_bytes in parts])
    return replace(
        snapshot,
        chunks=tuple(hold_in_memory(chunk, held) for chunk in snapshot.chunks),
        parts=tuple(
            IndexPart(name=name, size_bytes=size_bytes, resident=number < held)
            for number, (name, size_bytes) in enumerate(parts)
        ),
    )


def _with_codes(loader: ChunkLoader, chunks: list[LoadedChunk]) -> list[LoadedChunk]:
    """The chunks with their sign codes; as they are where those can't be had now, for then every
    row is compared, to the same answers."""
    try:
        return [_attach_sign_codes(loader, chunk) for chunk in chunks]
    except (Unavailable, OSError) as error:
        log.error("sign codes can't be loaded, search does without: %s", error)
        return chunks


def _attach_int8_to_all(loader: ChunkLoader, chunks: list[LoadedChunk]) -> list[LoadedChunk]:
    """The chunks with their int8 codes; all without where there is no room to keep them, for then
    every row is compared, to the same answers."""
    try:
        return [_attach_int8(loader, chunk, {}) for chunk in chunks]
    except OSError as error:
        log.error("int8 codes can't be kept, search does without: %s", error)
        return [
            replace(chunk, int8=None, stored=chunk.stored and replace(chunk.stored, int8=None))
            for chunk in chunks
        ]


def _attach_int8(
    loader: ChunkLoader, chunk: LoadedChunk, made: Mapping[UUID, Int8Codes]
) -> LoadedChunk:
    stored = chunk.stored
    if stored is None or stored.int8 is not None:
        return chunk
    codes = made.get(chunk.chunk_id) or loader.load_int8_codes(chunk.object_key, stored)
    return replace(chunk, int8=codes, stored=replace(stored, int8=codes))


def _attach_sign_codes(loader: ChunkLoader, chunk: LoadedChunk) -> LoadedChunk:
    """The chunk with its sign codes, where rows of this length have any."""
    stored = chunk.stored
    if stored is None or stored.codes is not None or stored.rows.shape[1] < CODED_DIMENSION:
        return chunk
    codes = loader.load_sign_codes(chunk.object_key, stored)
    return replace(chunk, codes=codes, stored=replace(stored, codes=codes))


def _compile_kernels(chunks: Sequence[LoadedChunk]) -> None:
    if any(chunk.codes is not None for chunk in chunks):
        from services.search.sign_code_search import compile_kernels

        compile_kernels()


def _apply_photo_changes(chunk: LoadedChunk, changes: dict[UUID, PhotoFilterValues]) -> LoadedChunk:
    """The chunk with what has changed of its photos; itself when nothing has."""
    photos = chunk.photos.with_changes(changes) if changes else chunk.photos
    return chunk if photos is chunk.photos else replace(chunk, photos=photos)


class ReplicationLagTracker:
    """What the following threads note and the probes read."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._current: dict[UUID, GenerationVersion] = {}
        self._synced_at: dict[UUID, float] = {}
        self._catalog_read_at: float | None = None

    def record_catalog_read(self, wanted: Mapping[UUID, GenerationVersion], at: float) -> None:
        """At `at` (monotonic) these were the generations and versions to follow."""
        with self._lock:
            self._catalog_read_at = at
            self._current = dict(wanted)
            # One that is new counts from now on; one that is gone counts no more.
            self._synced_at = {id_: self._synced_at.get(id_, at) for id_ in wanted}

    def record_synced(self, generation_id: UUID, at: float) -> None:
        """The snapshot has what the catalog had at `at`."""
        with self._lock:
            if generation_id in self._synced_at:
                self._synced_at[generation_id] = max(at, self._synced_at[generation_id])

    def has_read_catalog(self) -> bool:
        """Whether the catalog was read at all."""
        return self._catalog_read_at is not None

    def current_lags(self, loaded: Mapping[UUID, int]) -> dict[UUID, ReplicationLag]:
        """The lag of every generation to follow; `loaded` are the snapshots' versions."""
        with self._lock:
            now = time.monotonic()
            return {
                id_: ReplicationLag(
                    versions=max(0, wanted.version - loaded.get(id_, 0)),
                    seconds=now - self._synced_at[id_],
                    answers=wanted.state == GenerationState.ACTIVE,
                )
                for id_, wanted in self._current.items()
            }
