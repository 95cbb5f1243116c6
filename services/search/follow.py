"""From one version of a map to the next: load what is new, forget what is gone."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID

from sqlalchemy import select

from services.search.load import Loader, hold, loader_of, parts_of
from services.search.loaded_chunk import LoadedChunk
from services.search.memory import Memory
from services.search.photo_columns import PhotoColumns
from services.search.snapshot import Snapshot
from shared.catalog.chunks import live_chunks, live_facts
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoFacts, changed_since
from shared.catalog.session import Catalog
from shared.chunks import CODED_DIMENSION
from shared.errors import NotFound, Unavailable
from shared.objects import ObjectStore
from shared.read_retries import ReadRetries
from shared.search_protocol import Part
from shared.shards import WHOLE, Shard

if TYPE_CHECKING:
    from shared.codes.int8 import Int8Codes

log = logging.getLogger(__name__)

CODED_FROM_BYTES = 64_000_000  # of rows: less is compared faster as it is

FOLLOWED = (GenerationState.ACTIVE, GenerationState.BUILDING)


@dataclass(frozen=True, slots=True)
class Wanted:
    """A generation to follow: `version` is its map's, now."""

    version: int
    state: GenerationState


def wanted_versions(catalog: Catalog) -> dict[UUID, Wanted]:
    """Every generation to follow."""
    with catalog.read() as session:
        found = session.execute(
            select(Generation.id, Map.version, Generation.state)
            .join(Map, Map.id == Generation.map_id)
            .where(Generation.state.in_(FOLLOWED), Map.deleted_at.is_(None))
        )
        return {id_: Wanted(version, GenerationState(state)) for id_, version, state in found}


def advance(
    catalog: Catalog,
    store: ObjectStore,
    folder: Path,
    memory: Memory,
    generation_id: UUID,
    old: Snapshot | None,
    unreadable: ReadRetries,
    shard: Shard = WHOLE,
) -> Snapshot | None:
    """The shard's part of the generation as it is now, reusing what `old` has loaded; None when
    the generation is gone.

    Reads the catalog in one consistent transaction. A chunk that can't be read, or whose hash
    differs, is named in `missing`, and the rest is served; it is read again once `unreadable` says
    that it is due. Files are kept below `folder`.
    """
    loader = loader_of(store, folder, generation_id)
    with catalog.read() as session:
        generation = session.get(Generation, generation_id)
        if generation is None:
            memory.forget(generation_id)
            return None
        version = session.get_one(Map, generation.map_id).version
        chunks = [c for c in live_chunks(session, generation_id) if shard.owns(c.slot)]
        known = {c.chunk_id: c for c in old.chunks if not c.was_changed()} if old else {}
        changed = changed_since(session, generation.map_id, old.version) if old else []
        facts_of = {
            chunk.id: live_facts(session, chunk.id)
            for chunk in chunks
            if chunk.id not in known and unreadable.is_due(chunk.object_key)
        }
    changes = {photo.photo_id: photo for photo in changed}
    loaded: list[LoadedChunk] = []
    missing: list[str] = []
    for chunk in chunks:
        if chunk.id in known:
            loaded.append(_changed(known[chunk.id], changes))
            continue
        if chunk.id not in facts_of:
            missing.append(chunk.object_key)
            continue
        try:
            stored = loader.rows(chunk)
        except (Unavailable, NotFound, ValueError, OSError) as error:
            unreadable.failed(chunk.object_key, error)
            missing.append(chunk.object_key)
            continue
        unreadable.succeeded(chunk.object_key)
        photos = PhotoColumns.of(len(stored.rows), facts_of[chunk.id])
        loaded.append(LoadedChunk(chunk.id, chunk.object_key, stored.rows, photos, stored=stored))
    large = sum(chunk.rows.nbytes for chunk in loaded) >= CODED_FROM_BYTES
    if large:
        loaded = _with_codes(loader, loaded)
        _warm_up(loaded)
    loader.keep_only(loaded)
    middle = bool(loaded) and loaded[0].rows.shape[1] < CODED_DIMENSION
    if (middle and large) or (old is not None and old.bounded):
        loaded = _with_int8(loader, loaded)
    return _held(
        memory,
        Snapshot(
            generation_id=generation_id,
            map_id=generation.map_id,
            version=version,
            chunks=tuple(loaded),
            missing=tuple(missing),
        ),
    )


def bounded(
    store: ObjectStore,
    folder: Path,
    memory: Memory,
    old: Snapshot,
    made: Mapping[UUID, Int8Codes],
) -> Snapshot:
    """The same snapshot with int8 codes of every chunk: those that were made, by chunk id, and
    others that are made now."""
    loader = loader_of(store, folder, old.generation_id)
    return _held(memory, replace(old, chunks=tuple(_int8(loader, c, made) for c in old.chunks)))


def _held(memory: Memory, snapshot: Snapshot) -> Snapshot:
    """The snapshot with what the budget allows in memory."""
    parts = parts_of(snapshot.chunks)
    held = memory.parts_held(snapshot.generation_id, [size_bytes for _, size_bytes in parts])
    return replace(
        snapshot,
        chunks=tuple(hold(chunk, held) for chunk in snapshot.chunks),
        parts=tuple(
            Part(name=name, size_bytes=size_bytes, resident=number < held)
            for number, (name, size_bytes) in enumerate(parts)
        ),
    )


def _with_codes(loader: Loader, chunks: list[LoadedChunk]) -> list[LoadedChunk]:
    """The chunks with their sign codes; as they are where those can't be had now, for then every
    row is compared, to the same answers."""
    try:
        return [_coded(loader, chunk) for chunk in chunks]
    except (Unavailable, OSError) as error:
        log.error("sign codes can't be loaded, search does without: %s", error)
        return chunks


def _with_int8(loader: Loader, chunks: list[LoadedChunk]) -> list[LoadedChunk]:
    """The chunks with their int8 codes; all without where there is no room to keep them, for then
    every row is compared, to the same answers."""
    try:
        return [_int8(loader, chunk, {}) for chunk in chunks]
    except OSError as error:
        log.error("int8 codes can't be kept, search does without: %s", error)
        return [
            replace(chunk, int8=None, stored=chunk.stored and replace(chunk.stored, int8=None))
            for chunk in chunks
        ]


def _int8(loader: Loader, chunk: LoadedChunk, made: Mapping[UUID, Int8Codes]) -> LoadedChunk:
    stored = chunk.stored
    if stored is None or stored.int8 is not None:
        return chunk
    codes = made.get(chunk.chunk_id) or loader.int8_codes(chunk.object_key, stored)
    return replace(chunk, int8=codes, stored=replace(stored, int8=codes))


def _coded(loader: Loader, chunk: LoadedChunk) -> LoadedChunk:
    """The chunk with its sign codes, where rows of this length have any."""
    stored = chunk.stored
    if stored is None or stored.codes is not None or stored.rows.shape[1] < CODED_DIMENSION:
        return chunk
    codes = loader.codes(chunk.object_key, stored)
    return replace(chunk, codes=codes, stored=replace(stored, codes=codes))


def _warm_up(chunks: Sequence[LoadedChunk]) -> None:
    if any(chunk.codes is not None for chunk in chunks):
        from services.search.cascade import warm_up

        warm_up()


def _changed(chunk: LoadedChunk, changes: dict[UUID, PhotoFacts]) -> LoadedChunk:
    """The chunk with what has changed of its photos; itself when nothing has."""
    photos = chunk.photos.changed(changes) if changes else chunk.photos
    return chunk if photos is chunk.photos else replace(chunk, photos=photos)
