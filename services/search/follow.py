"""From one version of a map to the next: load what is new, forget what is gone."""

from __future__ import annotations

import logging
from uuid import UUID

import numpy as np
from sqlalchemy import select

from services.search.snapshot import LoadedChunk, Snapshot
from shared.catalog.chunks import Chunk, live_chunks, live_rows
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.catalog.photos import deleted_since
from shared.catalog.session import Catalog
from shared.chunks import read_chunk
from shared.errors import NotFound, Unavailable
from shared.objects import ObjectStore

log = logging.getLogger(__name__)

FOLLOWED = (GenerationState.ACTIVE, GenerationState.BUILDING)


def versions(catalog: Catalog) -> dict[UUID, tuple[UUID, int]]:
    """Every generation to follow, with its map and that map's version now."""
    with catalog.read() as session:
        found = session.execute(
            select(Generation.id, Map.id, Map.version)
            .join(Map, Map.id == Generation.map_id)
            .where(Generation.state.in_(FOLLOWED))
        )
        return {generation: (map_id, version) for generation, map_id, version in found}


def advance(
    catalog: Catalog, store: ObjectStore, generation_id: UUID, old: Snapshot | None
) -> Snapshot | None:
    """The generation as it is now, reusing what `old` has loaded; None when it is gone.

    Reads the catalog in one consistent transaction. A chunk that can't be read, or whose hash
    differs, is named in `missing`, and the rest is served.
    """
    with catalog.read() as session:
        generation = session.get(Generation, generation_id)
        if generation is None:
            return None
        version = session.get_one(Map, generation.map_id).version
        chunks = live_chunks(session, generation_id)
        known = {chunk.chunk_id: chunk for chunk in old.chunks} if old else {}
        gone = (
            frozenset(deleted_since(session, generation.map_id, old.version))
            if old
            else frozenset[UUID]()
        )
        rows_of = {
            chunk.id: live_rows(session, chunk.id) for chunk in chunks if chunk.id not in known
        }
    loaded: list[LoadedChunk] = []
    missing: list[str] = []
    for chunk in chunks:
        if chunk.id in known:
            loaded.append(_without(known[chunk.id], gone))
            continue
        try:
            loaded.append(_load(store, chunk, rows_of[chunk.id]))
        except (Unavailable, NotFound, ValueError, OSError) as error:
            log.error("chunk %s can't be served: %s", chunk.object_key, error)
            missing.append(chunk.object_key)
    return Snapshot(
        generation_id=generation_id,
        map_id=generation.map_id,
        version=version,
        chunks=tuple(loaded),
        missing=tuple(missing),
        live_rows=sum(int(chunk.alive.sum()) for chunk in loaded),
    )


def _load(store: ObjectStore, chunk: Chunk, live: list[tuple[int, UUID]]) -> LoadedChunk:
    rows = read_chunk(store, chunk.object_key, chunk.sha256)
    photo_ids = np.full(len(rows), None, dtype=object)
    alive = np.zeros(len(rows), dtype=bool)
    for row, photo_id in live:
        photo_ids[row] = photo_id
        alive[row] = True
    return LoadedChunk(chunk.id, chunk.object_key, rows, photo_ids, alive)


def _without(chunk: LoadedChunk, gone: frozenset[UUID]) -> LoadedChunk:
    """The chunk with the rows of deleted photos dead; itself when it has none of them."""
    if not gone:
        return chunk
    dead = [row for row, photo_id in enumerate(chunk.photo_ids) if photo_id in gone]
    if not dead:
        return chunk
    alive = chunk.alive.copy()
    alive[dead] = False
    return LoadedChunk(chunk.chunk_id, chunk.object_key, chunk.rows, chunk.photo_ids, alive)
