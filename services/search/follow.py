"""From one version of a map to the next: load what is new, forget what is gone."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from uuid import UUID

from sqlalchemy import select

from services.search.snapshot import LoadedChunk, PhotoColumns, Snapshot
from shared.catalog.chunks import Chunk, live_chunks, live_facts
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoFacts, changed_since
from shared.catalog.session import Catalog
from shared.chunks import read_chunk
from shared.errors import NotFound, Unavailable
from shared.objects import ObjectStore
from shared.shards import WHOLE, Shard

log = logging.getLogger(__name__)

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
    generation_id: UUID,
    old: Snapshot | None,
    shard: Shard = WHOLE,
) -> Snapshot | None:
    """The shard's part of the generation as it is now, reusing what `old` has loaded; None when
    the generation is gone.

    Reads the catalog in one consistent transaction. A chunk that can't be read, or whose hash
    differs, is named in `missing`, and the rest is served.
    """
    with catalog.read() as session:
        generation = session.get(Generation, generation_id)
        if generation is None:
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
            loaded.append(_load(store, chunk, facts_of[chunk.id]))
        except (Unavailable, NotFound, ValueError, OSError) as error:
            log.error("chunk %s can't be served: %s", chunk.object_key, error)
            missing.append(chunk.object_key)
    return Snapshot(
        generation_id=generation_id,
        map_id=generation.map_id,
        version=version,
        chunks=tuple(loaded),
        missing=tuple(missing),
        live_rows=sum(int(chunk.photos.findable.sum()) for chunk in loaded),
        by_key={chunk.object_key: chunk for chunk in loaded},
    )


def _load(store: ObjectStore, chunk: Chunk, facts: list[tuple[int, PhotoFacts]]) -> LoadedChunk:
    rows = read_chunk(store, chunk.object_key, chunk.sha256)
    return LoadedChunk(chunk.id, chunk.object_key, rows, PhotoColumns.of(len(rows), facts))


def _changed(chunk: LoadedChunk, changes: dict[UUID, PhotoFacts]) -> LoadedChunk:
    """The chunk with what has changed of its photos; itself when nothing has."""
    photos = chunk.photos.changed(changes) if changes else chunk.photos
    if photos is chunk.photos:
        return chunk
    return LoadedChunk(chunk.chunk_id, chunk.object_key, chunk.rows, photos)
