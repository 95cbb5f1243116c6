"""Catalog sync: brings a worker's snapshots to the current version of their maps.

`sync_snapshot` loads new chunks, drops removed ones and applies changes of photos.
`ReplicationLagTracker` measures the lag without reading the catalog, so that a worker that is stuck
in loading, or can't reach the catalog, notices its own lag: what counts is the time when a snapshot
was last known to be current.
"""

from __future__ import annotations

import errno
import logging
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from uuid import UUID

from sqlalchemy import select

from services.search.chunk_loader import (
    ChunkLoader,
    LoadedChunk,
    MemoryBudget,
    hold_in_memory,
    memory_parts,
)
from services.search.dense_scan import compile_kernel
from services.search.photo_columns import PhotoColumns
from services.search.snapshot import Snapshot
from shared.catalog.chunks import list_live_chunks, list_live_filter_values
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoFilterValues, list_photos_changed_since
from shared.errors import NotFound, Unavailable
from shared.search_api.protocol import ReplicationLag
from shared.storage import ObjectStore
from shared.storage.chunks import CODED_DIMENSION
from shared.storage.read_retries import ReadRetries

log = logging.getLogger(__name__)

MIN_CODED_BYTES = 64_000_000  # of rows; smaller generations are scanned faster without codes

FULL_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT)
SYNCED_STATES = (GenerationState.ACTIVE, GenerationState.BUILDING)


@dataclass(frozen=True, slots=True)
class _GenerationVersion:
    """State of a generation to sync, and the current version of its map."""

    version: int
    state: GenerationState


def read_generation_versions(catalog: Catalog) -> dict[UUID, _GenerationVersion]:
    """Read the versions of all generations to sync."""
    with catalog.read() as session:
        rows = session.execute(
            select(Generation.id, Map.version, Generation.state)
            .join(Map, Map.id == Generation.map_id)
            .where(Generation.state.in_(SYNCED_STATES), Map.deleted_at.is_(None))
        )
        return {
            id_: _GenerationVersion(version, GenerationState(state)) for id_, version, state in rows
        }


def sync_snapshot(
    catalog: Catalog,
    store: ObjectStore,
    folder: Path,
    memory_budget: MemoryBudget,
    generation_id: UUID,
    old: Snapshot | None,
    unreadable: ReadRetries,
) -> Snapshot | None:
    """Build the snapshot of a generation, reusing the chunks of `old`.

    The catalog is read in one consistent transaction. A chunk that can't be read, or whose hash
    differs, is named in `missing` and read again once `unreadable` says so; the others are served.
    Files are cached below `folder`. `memory_budget` decides which parts are held in memory.

    Returns:
        The new snapshot; None if the generation no longer exists.
    """
    loader = ChunkLoader(store, folder / str(generation_id))
    with catalog.read() as session:
        generation = session.get(Generation, generation_id)
        if generation is None:
            memory_budget.release_generation(generation_id)
            return None
        version = session.get_one(Map, generation.map_id).version
        chunks = list_live_chunks(session, generation_id)
        known = {c.chunk_id: c for c in old.chunks if not c.was_changed()} if old else {}
        changed = list_photos_changed_since(session, generation.map_id, old.version) if old else []
        filter_values = {
            chunk.id: list_live_filter_values(session, chunk.id)
            for chunk in chunks
            if chunk.id not in known and unreadable.is_due(chunk.object_key)
        }
    changes = {photo.photo_id: photo for photo in changed}
    loaded: list[LoadedChunk] = []
    missing: list[str] = []
    disk_full = False
    for chunk in chunks:
        if chunk.id in known:
            loaded.append(_apply_photo_changes(known[chunk.id], changes))
            continue
        if chunk.id not in filter_values:
            missing.append(chunk.object_key)
            disk_full |= old is not None and old.disk_full
            continue
        try:
            stored = loader.load_rows(chunk)
        except (Unavailable, NotFound, ValueError, OSError) as error:
            disk_full |= isinstance(error, OSError) and error.errno in FULL_DISK_ERRORS
            unreadable.failed(chunk.object_key, error)
            missing.append(chunk.object_key)
            continue
        unreadable.succeeded(chunk.object_key)
        photos = PhotoColumns.of(len(stored.rows), filter_values[chunk.id])
        loaded.append(LoadedChunk(chunk.id, chunk.object_key, stored.rows, photos, stored=stored))
    large = sum(chunk.rows.nbytes for chunk in loaded) >= MIN_CODED_BYTES
    long_rows = any(chunk.rows.shape[1] >= CODED_DIMENSION for chunk in loaded)
    if long_rows and (large or (old is not None and old.has_sign_codes)):
        loaded = _with_codes(loader, loaded)
    loader.evict_except(loaded)
    snapshot = Snapshot(
        generation_id=generation_id,
        map_id=generation.map_id,
        version=version,
        chunks=tuple(loaded),
        missing=tuple(missing),
        disk_full=disk_full,
    )
    compile_kernel(snapshot)
    return _apply_memory_budget(memory_budget, snapshot)


def _apply_memory_budget(memory_budget: MemoryBudget, snapshot: Snapshot) -> Snapshot:
    """Return the snapshot with as many parts in memory as the budget allows."""
    sizes = memory_parts(snapshot.chunks)
    resident_parts = memory_budget.allocate(snapshot.generation_id, sizes)
    return replace(
        snapshot,
        chunks=tuple(hold_in_memory(chunk, resident_parts) for chunk in snapshot.chunks),
        resident_bytes=sum(sizes[:resident_parts]),
        mapped_bytes=sum(sizes[resident_parts:]),
    )


def _with_codes(loader: ChunkLoader, chunks: list[LoadedChunk]) -> list[LoadedChunk]:
    """Return the chunks with their codes, or all without if those can't be loaded or stored.

    Without codes every row is compared, with the same results.
    """
    try:
        coded = [_attach_codes(loader, chunk) for chunk in chunks]
    except (Unavailable, OSError) as error:
        log.error("codes can't be loaded or stored, searching without them: %s", error)
        return [
            replace(chunk, codes=None, stored=chunk.stored and replace(chunk.stored, codes=None))
            for chunk in chunks
        ]
    from services.search.sign_code_search import compile_kernels

    compile_kernels()
    return coded


def _attach_codes(loader: ChunkLoader, chunk: LoadedChunk) -> LoadedChunk:
    stored = chunk.stored
    if stored is None or stored.codes is not None:
        return chunk
    codes = loader.load_sign_codes(chunk.object_key, stored)
    return replace(chunk, codes=codes, stored=replace(stored, codes=codes))


def _apply_photo_changes(chunk: LoadedChunk, changes: dict[UUID, PhotoFilterValues]) -> LoadedChunk:
    """Return the chunk with changes of its photos; itself if there are none."""
    photos = chunk.photos.with_changes(changes) if changes else chunk.photos
    return chunk if photos is chunk.photos else replace(chunk, photos=photos)


class ReplicationLagTracker:
    """Tracks the replication lag of each generation; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._current: dict[UUID, _GenerationVersion] = {}
        self._synced_at: dict[UUID, float] = {}
        self.catalog_read_at: float | None = None

    def record_catalog_read(self, current: Mapping[UUID, _GenerationVersion], at: float) -> None:
        """Record the generations and versions that the catalog had at `at` (monotonic seconds)."""
        with self._lock:
            self.catalog_read_at = at
            self._current = dict(current)
            # The lag of new generations counts from now on; deleted ones are dropped.
            self._synced_at = {id_: self._synced_at.get(id_, at) for id_ in current}

    def record_synced(self, generation_id: UUID, at: float) -> None:
        """Record that the snapshot has what the catalog had at `at` (monotonic seconds)."""
        with self._lock:
            if generation_id in self._synced_at:
                self._synced_at[generation_id] = max(at, self._synced_at[generation_id])

    def current_lags(self, loaded: Mapping[UUID, int]) -> dict[UUID, ReplicationLag]:
        """Return the lag of every generation; `loaded` are the versions of the snapshots."""
        with self._lock:
            now = time.monotonic()
            return {
                id_: ReplicationLag(
                    versions=max(0, target.version - loaded.get(id_, 0)),
                    seconds=now - self._synced_at[id_],
                    answers=target.state == GenerationState.ACTIVE,
                )
                for id_, target in self._current.items()
            }
