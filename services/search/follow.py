"""From one version of a map to the next: load what is new, forget what is gone."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from uuid import UUID

from sqlalchemy import select

from services.search.load import Loader, hold, parts_of
from services.search.memory import Memory
from services.search.photo_columns import PhotoColumns
from services.search.snapshot import LoadedChunk, Snapshot
from shared.catalog.chunks import live_chunks, live_facts
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoFacts, changed_since
from shared.catalog.session import Catalog
from shared.chunks import CODED_DIMENSION
from shared.errors import NotFound, Unavailable
from shared.objects import ObjectStore
from shared.search_protocol import Part
from shared.shards import WHOLE, Shard

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
    shard: Shard = WHOLE,
) -> Snapshot | None:
    """The shard's part of the generation as it is now, reusing what `old` has loaded; None when
    the generation is gone.

    Reads the catalog in one consistent transaction. A chunk that can't be read, or whose hash
    differs, is named in `missing`, and the rest is served. Files are kept below `folder`.
    """
    loader = Loader(store, folder / str(generation_id))
    with catalog.read() as session:
        generation = session.get(Generation, generation_id)
        if generation is None:
            memory.forget(generation_id)
            return None
        version = session.get_one(Map, generation.map_id).version
        chunks = [c for c in live_chunks(session, generation_id) if shard.owns(c.slot)]
        known = {chunk.chunk_id: chunk for chunk in old.chunks} if old else {}
        changed = changed_since(session, generation.map_id, old.version) if old else []
        facts_of = {
            chunk.id: live_facts(session, chunk.id) for chunk in chunks if chunk.id not in known
        }
    changes = {photo.photo_id: photo for photo in changed}
    loaded: list[LoadedChunk] = []
    missing: list[str] = []
    for chunk in chunks:
        if chunk.id in known:
            loaded.append(_changed(known[chunk.id], changes))
            continue
        try:
            stored = loader.rows(chunk)
        except (Unavailable, NotFound, ValueError, OSError) as error:
            log.error("chunk %s can't be served: %s", chunk.object_key, error)
            missing.append(chunk.object_key)
            continue
        photos = PhotoColumns.of(len(stored.rows), facts_of[chunk.id])
        loaded.append(LoadedChunk(chunk.id, chunk.object_key, stored.rows, photos, stored=stored))
    if sum(chunk.rows.nbytes for chunk in loaded) >= CODED_FROM_BYTES:
        loaded = [_coded(loader, chunk) for chunk in loaded]
        _warm_up(loaded)
    loader.keep_only(loaded)
    parts = parts_of(loaded)
    held = memory.parts_held(generation_id, [size_bytes for _, size_bytes in parts])
    return Snapshot(
        generation_id=generation_id,
        map_id=generation.map_id,
        version=version,
        chunks=tuple(hold(chunk, held) for chunk in loaded),
        missing=tuple(missing),
        parts=tuple(
            Part(name=name, size_bytes=size_bytes, resident=number < held)
            for number, (name, size_bytes) in enumerate(parts)
        ),
    )


def _coded(loader: Loader, chunk: LoadedChunk) -> LoadedChunk:
    """The chunk with its codes, where rows of this length have any."""
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
