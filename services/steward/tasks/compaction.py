"""Compaction: merges small chunks into larger ones and drops rows of deleted photos.

In tiers, so that a row is rarely merged more than twice: new chunks are merged with each other, and
the results with one another once they make a full chunk.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict
from uuid import UUID

import numpy as np
from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from services.steward.periodic_tasks import periodic_task
from shared.catalog.chunks import Chunk, Descriptor, list_live_rows
from shared.catalog.database.base import count_rows, db_now
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, lock_generation
from shared.catalog.maps import Map, increment_map_version, lock_map
from shared.catalog.photos import Photo, is_kept
from shared.config.settings import Settings
from shared.errors import NotFound, Unavailable
from shared.ids import new_id
from shared.storage import ObjectStore
from shared.storage.chunks import features_key, read_chunk, write_chunk
from shared.storage.feature_files import FeatureRows, read_feature_file
from shared.storage.read_retries import ReadRetries

log = logging.getLogger(__name__)

COMPACT_CHUNKS = 8  # new chunks that are merged
# Of small batches there are many small chunks: they are merged again from this multiple of
# COMPACT_CHUNKS on, because a search worker holds each chunk as an open file.
MAX_CHUNKS_FACTOR = 4
FULL_SHARE = 0.75  # of CHUNK_ROWS; a chunk with fewer rows is small

DEAD_ROW_SAMPLE = 100  # chunks whose dead rows one run counts: 100,000 rows, about 0.2 s
DEAD_ROW_SHARE = 0.2  # of a chunk's rows; with more, it is rewritten


@periodic_task(5.0, own_thread=True, counter="compactions")
def merge_small_chunks(
    catalog: Catalog,
    store: ObjectStore,
    settings: Settings,
    compact_chunks: int = COMPACT_CHUNKS,
    retries: ReadRetries | None = None,
) -> int:
    """Merge the small chunks of every generation, and rewrite chunks with many dead rows.

    Args:
        settings: `chunk_rows` is the maximum of a merged chunk.
        compact_chunks: New chunks are merged from this number on.
        retries: Backoff for unreadable chunks, so that not every run reads them.

    Returns:
        The number of chunks written, or dropped because no row is left.
    """
    retries = retries or ReadRetries()
    merges = _find_merges(catalog, settings.chunk_rows, compact_chunks, retries)
    return sum(merge_chunks(catalog, store, *merge, retries) for merge in merges)


def merge_chunks(
    catalog: Catalog,
    store: ObjectStore,
    generation_id: UUID,
    chunk_ids: Collection[UUID],
    retries: ReadRetries,
) -> bool:
    """Write the live rows of chunks of a generation into one new chunk.

    Returns:
        False if one of them can't be read, or was replaced meanwhile: the catalog is left
        unchanged.
    """
    with catalog.read() as session:
        generation = session.get_one(Generation, generation_id)
        old = _list_live(session, chunk_ids)
        live_rows = {chunk.id: list_live_rows(session, chunk.id) for chunk in old}
    rows = []
    for chunk in old:
        try:
            rows.append(read_chunk(store, chunk.object_key, chunk.sha256))
        except (Unavailable, NotFound) as error:
            retries.failed(chunk.object_key, error)
            return False
        retries.succeeded(chunk.object_key)
    photo_ids = [photo_id for chunk in old for _, photo_id in live_rows[chunk.id]]
    new_chunk, chunk_id = None, new_id()
    if photo_ids:
        matrix = np.concatenate(
            [part[[row for row, _ in live_rows[c.id]]] for c, part in zip(old, rows, strict=True)]
        )
        new_chunk = write_chunk(
            store,
            generation_id=generation_id,
            chunk_id=chunk_id,
            rows=matrix.astype(generation.row_type, copy=False),
            photo_ids=photo_ids,
            spec=generation.spec,
            features=_merge_features(store, old, live_rows),
        )
    with catalog.write() as session:
        lock_map(session, generation.map_id)
        generation = lock_generation(session, generation_id)
        old_ids = [chunk.id for chunk in _list_live(session, chunk_ids)]
        if len(old_ids) < len(chunk_ids):
            # Another steward merged them: the new file is an orphan.
            return False
        # Rows of photos deleted meanwhile were copied, too: they are dead rows of the new chunk.
        present = set(
            session.scalars(select(Descriptor.photo_id).where(Descriptor.chunk_id.in_(old_ids)))
        )
        session.execute(delete(Descriptor).where(Descriptor.chunk_id.in_(old_ids)))
        if new_chunk is not None:
            columns = {"generation_id": generation_id, "sealed": True, **asdict(new_chunk)}
            session.add(Chunk(id=chunk_id, **columns))
            session.flush()
            place = {"generation_id": generation_id, "chunk_id": chunk_id}
            session.add_all(
                Descriptor(**place, photo_id=photo_id, row=row)
                for row, photo_id in enumerate(photo_ids)
                if photo_id in present
            )
        session.execute(update(Chunk).where(Chunk.id.in_(old_ids)).values(superseded_at=db_now()))
        increment_map_version(session, generation.map_id)
    log.info("merged %d chunks of generation %s", len(old), generation_id)
    return True


def _merge_features(
    store: ObjectStore, chunks: Sequence[Chunk], live_rows: dict[UUID, list[tuple[int, UUID]]]
) -> FeatureRows | None:
    """Return the local features of the live rows, of the model of the newest ones; None without.

    Those of another model, and of a file that is damaged or missing, are dropped.
    """
    model = next((c.features_model for c in reversed(chunks) if c.features_model), None)
    merged: list[bytes | memoryview] = []
    for chunk in chunks:
        rows: Sequence[bytes | memoryview] = [b""] * chunk.rows
        if model and chunk.features_model == model:
            key = features_key(chunk.object_key)
            try:
                rows = read_feature_file(store, key, chunk.features_sha256).rows
            except (NotFound, ValueError) as error:
                log.error("the local features %s are dropped: %s", key, error)
        merged += [rows[row] for row, _ in live_rows[chunk.id]]
    return FeatureRows(model, merged) if model else None


def _list_live(session: Session, chunk_ids: Collection[UUID]) -> Sequence[Chunk]:
    live = select(Chunk).where(Chunk.id.in_(chunk_ids), Chunk.superseded_at.is_(None))
    return session.scalars(live.order_by(Chunk.id)).all()


def _find_merges(
    catalog: Catalog, chunk_rows: int, compact_chunks: int, retries: ReadRetries
) -> list[tuple[UUID, list[UUID]]]:
    """Return generations with chunks to make one of; only chunks that may be read.

    Dead rows are counted in a new random sample of DEAD_ROW_SAMPLE chunks in each run: counting
    those of a large catalog would load the database.
    """
    live = (
        select(Chunk)
        .join(Generation, Generation.id == Chunk.generation_id)
        .join(Map, Map.id == Generation.map_id)
        .where(
            Map.deleted_at.is_(None),
            Chunk.superseded_at.is_(None),
            Generation.state.in_((GenerationState.ACTIVE, GenerationState.BUILDING)),
        )
    )
    with catalog.read() as session:
        small = session.scalars(live.where(Chunk.rows < FULL_SHARE * chunk_rows).order_by(Chunk.id))
        sampled = session.scalars(live.order_by(func.random()).limit(DEAD_ROW_SAMPLE)).all()
        dead = [
            chunk
            for chunk in sampled
            if retries.is_due(chunk.object_key)
            and chunk.rows - _count_live_rows(session, chunk.id) > DEAD_ROW_SHARE * chunk.rows
        ]
        due: dict[UUID, list[Chunk]] = {}
        for chunk in small:
            if retries.is_due(chunk.object_key) and chunk not in dead:
                due.setdefault(chunk.generation_id, []).append(chunk)
    found = [[chunk] for chunk in dead]
    for chunks in due.values():
        found += group_chunks(chunks, chunk_rows, compact_chunks)
    return [(chunks[0].generation_id, [chunk.id for chunk in chunks]) for chunks in found]


def group_chunks(small: Iterable[Chunk], chunk_rows: int, compact_chunks: int) -> list[list[Chunk]]:
    """Return those of a generation's small chunks that are to be merged, in groups."""
    groups: list[list[Chunk]] = [[]]
    for chunk in small:
        if sum(one.rows for one in groups[-1]) + chunk.rows > chunk_rows:
            groups.append([])
        groups[-1].append(chunk)
    rest = groups.pop()  # has room for more
    if len(rest) < MAX_CHUNKS_FACTOR * compact_chunks:
        rest = [chunk for chunk in rest if not chunk.sealed]
    if len(rest) >= compact_chunks:
        groups.append(rest)
    return [group for group in groups if len(group) > 1]


def _count_live_rows(session: Session, chunk_id: UUID) -> int:
    """Count the rows of the chunk that `list_live_rows` lists."""
    live = select(Descriptor.row).join(Photo, Photo.id == Descriptor.photo_id)
    return count_rows(session, live.where(Descriptor.chunk_id == chunk_id, is_kept()))
