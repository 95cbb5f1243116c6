"""Compaction: merges the small chunks of a slot into one and drops rows of deleted photos.

In tiers, so that a row is rarely merged more than twice: new chunks of an open slot are merged with
each other, and the results with one another once the slot is full.
"""

from __future__ import annotations

import logging
import random
from collections.abc import Sequence
from dataclasses import asdict
from uuid import UUID

import numpy as np
from sqlalchemy import case, delete, func, select, update
from sqlalchemy.orm import Session

from services.steward.periodic_tasks import periodic_task
from shared.catalog.chunks import Chunk, Descriptor, list_live_rows
from shared.catalog.database.base import count_rows, db_now
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, lock_generation
from shared.catalog.maps import Map, increment_map_version, lock_map
from shared.catalog.photos import Photo, is_kept
from shared.errors import NotFound, Unavailable
from shared.ids import new_id
from shared.storage import ObjectStore
from shared.storage.chunks import features_key, read_chunk, write_chunk
from shared.storage.feature_files import FeatureRows, read_feature_file
from shared.storage.read_retries import ReadRetries

log = logging.getLogger(__name__)

# An open slot of small batches has many merged chunks: they are merged again from this multiple of
# COMPACT_CHUNKS on, because a search worker holds each chunk as an open file.
COMPACT_CHUNKS = 8  # new chunks of an open slot that are merged
MAX_CHUNKS_FACTOR = 4

DEAD_ROW_SAMPLE_SLOTS = 100  # slots whose dead rows one run counts: 100,000 rows, about 0.2 s
DEAD_ROW_SHARE = 0.2  # of a slot's rows; with more, it is rewritten


@periodic_task(5.0, own_thread=True, counter="slots_merged")
def merge_small_chunks(
    catalog: Catalog,
    store: ObjectStore,
    compact_chunks: int = COMPACT_CHUNKS,
    retries: ReadRetries | None = None,
) -> int:
    """Merge every slot that needs it.

    Args:
        compact_chunks: New chunks of an open slot are merged from this number on.
        retries: Backoff for slots with unreadable chunks, so that not every run reads them.

    Returns:
        The number of slots merged.
    """
    retries = retries or ReadRetries()
    merged = 0
    for generation_id, slot, new_only in _find_slots_to_merge(catalog, compact_chunks):
        name = f"slot {slot} of generation {generation_id}"
        if not retries.is_due(name):
            continue
        try:
            merged += merge_slot(catalog, store, generation_id, slot, new_only=new_only)
            retries.succeeded(name)
        except (Unavailable, NotFound) as error:
            retries.failed(name, error)
    return merged


def merge_slot(
    catalog: Catalog,
    store: ObjectStore,
    generation_id: UUID,
    slot: int,
    *,
    new_only: bool = False,
) -> bool:
    """Write the live rows of the slot, or of its chunks that were never merged, into one new chunk.

    Returns:
        False if one of these chunks was replaced meanwhile: the catalog is left unchanged.
    """
    with catalog.read() as session:
        generation = session.get_one(Generation, generation_id)
        old = [
            chunk
            for chunk in _slot_chunks(session, generation_id, slot)
            if not (new_only and chunk.sealed)
        ]
        live_rows = {chunk.id: list_live_rows(session, chunk.id) for chunk in old}
    rows = [read_chunk(store, chunk.object_key, chunk.sha256) for chunk in old]
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
        current = {chunk.id for chunk in _slot_chunks(session, generation_id, slot)}
        if not current.issuperset(chunk.id for chunk in old):
            # Another steward merged the slot: the new file is an orphan.
            return False
        old_ids = [chunk.id for chunk in old]
        # Rows of photos deleted meanwhile were copied, too: they are dead rows of the new chunk.
        present = set(
            session.scalars(select(Descriptor.photo_id).where(Descriptor.chunk_id.in_(old_ids)))
        )
        session.execute(delete(Descriptor).where(Descriptor.chunk_id.in_(old_ids)))
        if new_chunk is not None:
            session.add(
                Chunk(
                    id=chunk_id,
                    generation_id=generation_id,
                    slot=slot,
                    sealed=True,
                    **asdict(new_chunk),
                )
            )
            session.flush()
            session.add_all(
                Descriptor(
                    generation_id=generation_id,
                    photo_id=photo_id,
                    chunk_id=chunk_id,
                    row=row,
                )
                for row, photo_id in enumerate(photo_ids)
                if photo_id in present
            )
        session.execute(update(Chunk).where(Chunk.id.in_(old_ids)).values(superseded_at=db_now()))
        increment_map_version(session, generation.map_id)
    log.info("merged %d chunks of slot %d of generation %s", len(old), slot, generation_id)
    return True


def _merge_features(
    store: ObjectStore, chunks: list[Chunk], live_rows: dict[UUID, list[tuple[int, UUID]]]
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


def _slot_chunks(session: Session, generation_id: UUID, slot: int) -> list[Chunk]:
    return list(
        session.scalars(
            select(Chunk)
            .where(
                Chunk.generation_id == generation_id,
                Chunk.slot == slot,
                Chunk.superseded_at.is_(None),
            )
            .order_by(Chunk.id)
        )
    )


def _find_slots_to_merge(catalog: Catalog, compact_chunks: int) -> list[tuple[UUID, int, bool]]:
    """Return full slots of several chunks, open slots of many chunks, and slots with dead rows.

    Each with its generation, and whether only its chunks that were never merged are to be merged.
    Dead rows are counted in a new random sample of DEAD_ROW_SAMPLE_SLOTS slots in each run:
    counting those of a large catalog would load the database.
    """
    with catalog.read() as session:
        slots = session.execute(
            select(
                Chunk.generation_id,
                Chunk.slot,
                Generation.open_slot,
                func.count(),
                func.sum(case((Chunk.sealed, 0), else_=1)),
                func.sum(Chunk.rows),
            )
            .join(Generation, Generation.id == Chunk.generation_id)
            .join(Map, Map.id == Generation.map_id)
            .where(
                Map.deleted_at.is_(None),
                Chunk.superseded_at.is_(None),
                Generation.state.in_((GenerationState.ACTIVE, GenerationState.BUILDING)),
            )
            .group_by(Chunk.generation_id, Chunk.slot, Generation.open_slot)
        ).all()
        sampled = random.sample(slots, min(DEAD_ROW_SAMPLE_SLOTS, len(slots)))
        dead = {
            (generation_id, slot)
            for generation_id, slot, _, _, _, rows in sampled
            if rows - _count_live_rows(session, generation_id, slot) > DEAD_ROW_SHARE * rows
        }
    found = []
    for generation_id, slot, open_slot, chunks, new, _ in slots:
        if (
            (slot < open_slot and chunks > 1)
            or chunks >= MAX_CHUNKS_FACTOR * compact_chunks
            or (generation_id, slot) in dead
        ):
            found.append((generation_id, slot, False))
        elif new >= compact_chunks:
            found.append((generation_id, slot, True))
    return found


def _count_live_rows(session: Session, generation_id: UUID, slot: int) -> int:
    """Count the rows of the slot that `list_live_rows` lists."""
    live = (
        select(Chunk.id)
        .join(Descriptor, Descriptor.chunk_id == Chunk.id)
        .join(Photo, Photo.id == Descriptor.photo_id)
        .where(
            Chunk.generation_id == generation_id,
            Chunk.slot == slot,
            Chunk.superseded_at.is_(None),
            is_kept(),
        )
    )
    return count_rows(session, live)
