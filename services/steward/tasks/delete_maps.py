"""Purges deleted maps: deletes their objects, then the rows that refer to them.

Works in small steps and continues from what is left, so a crash repeats at most one harmless step.
Rows that a concurrent request still writes into the map are found by the next run. The map's own
row is deleted last.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from uuid import UUID

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from services.steward.periodic_tasks import periodic_task
from services.steward.tasks.garbage_collection import (
    ROWS_PER_TRANSACTION,
    delete_chunks,
    delete_queries,
    delete_reconstructions,
    delete_with_objects,
    deletion_is_journaled,
    journal_deletions,
)
from services.steward.tasks.maintenance import TRACKS_PER_TRANSACTION
from shared.catalog.batch_items import BatchItem
from shared.catalog.chunks import Descriptor
from shared.catalog.database.base import affected_rows, is_journaled
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Evaluation, Generation
from shared.catalog.jobs import UPLOAD_JOBS, Job, JobKind
from shared.catalog.maps import CachedMapStatistics, Map, Search
from shared.catalog.photos import Photo
from shared.catalog.reconstructions import Reconstruction
from shared.catalog.tracks import Track, delete_tracks
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.jobs.transitions import cancel_jobs
from shared.storage import ObjectStore
from shared.storage.keys import ORIGINALS, derived_image_keys

log = logging.getLogger(__name__)

CHUNKS_PER_STEP = 50  # of up to CHUNK_ROWS descriptors each
SLICE_SECONDS = 2.0  # of one run, so that the steward's other tasks are not delayed


@periodic_task(1.0, own_thread=True)
def purge_deleted_maps(catalog: Catalog, store: ObjectStore) -> None:
    """Continue purging the deleted maps, for up to SLICE_SECONDS."""
    journal_deletions(catalog, store, Map)
    with catalog.read() as session:
        map_ids = session.scalars(
            select(Map.id).where(Map.deleted_at.is_not(None), deletion_is_journaled(Map))
        ).all()
    deadline = time.monotonic() + SLICE_SECONDS
    for map_id in map_ids:
        while not _purge_next(catalog, store, map_id):
            if time.monotonic() > deadline:
                return


def _purge_next(catalog: Catalog, store: ObjectStore, map_id: UUID) -> bool:
    """Delete the next rows of the map with their objects; True when nothing is left to delete."""
    reconstructions = select(Reconstruction).where(Reconstruction.map_id == map_id)
    steps: tuple[Callable[[], bool], ...] = (
        lambda: _cancel_jobs(catalog, map_id),
        lambda: delete_chunks(catalog, store, Generation.map_id == map_id, limit=CHUNKS_PER_STEP),
        lambda: delete_queries(catalog, store, Job.map_id == map_id),
        lambda: _purge_batches(catalog, store, map_id),
        lambda: delete_reconstructions(catalog, store, reconstructions),
        lambda: _purge_photos(catalog, store, map_id),
        lambda: _purge_searches(catalog, map_id),
        lambda: _purge_tracks(catalog, map_id),
    )
    if any(delete_rows() for delete_rows in steps):  # one deleted some; there may be more
        return False
    _purge_vocabulary_objects(catalog, store, map_id)
    with catalog.write() as session:
        tables = (CachedMapStatistics, Evaluation, Job, Generation, Vocabulary, StoredWhitening)
        for table in tables:
            session.execute(delete(table).where(table.map_id == map_id))
        # Not before the journal records it: else a rebuild of the catalog would restore the map.
        deleted = session.execute(delete(Map).where(Map.id == map_id, is_journaled(Map)))
    if affected_rows(deleted):
        log.info("purged the deleted map %s", map_id)
    return True


def _cancel_jobs(catalog: Catalog, map_id: UUID) -> bool:
    with catalog.write() as session:
        return cancel_jobs(session, Job.map_id == map_id) > 0


def _purge_batches(catalog: Catalog, store: ObjectStore, map_id: UUID) -> bool:
    """Delete batch items, and uploaded files that did not become photos."""
    with catalog.read() as session:
        items = session.scalars(
            select(BatchItem)
            .join(Job, Job.id == BatchItem.job_id)
            .where(Job.map_id == map_id)
            .limit(ROWS_PER_TRANSACTION)
        ).all()
    for item in items:
        if item.photo_id is None and item.object_key and item.object_key.startswith(ORIGINALS):
            store.delete(item.object_key)
    if items:
        with catalog.write() as session:
            for job_id in {item.job_id for item in items}:
                numbers = [item.number for item in items if item.job_id == job_id]
                session.execute(
                    delete(BatchItem).where(
                        BatchItem.job_id == job_id, BatchItem.number.in_(numbers)
                    )
                )
    return bool(items)


def _purge_photos(catalog: Catalog, store: ObjectStore, map_id: UUID) -> bool:
    def object_keys(photo: Photo) -> tuple[str, ...]:
        # Without a key, its objects were deleted with the photo.
        return (*filter(None, [photo.object_key]), *derived_image_keys(photo.id))

    def delete_rows(session: Session, photos: Sequence[Photo]) -> None:
        ids = [photo.id for photo in photos]
        session.execute(delete(Descriptor).where(Descriptor.photo_id.in_(ids)))
        session.execute(delete(Job).where(Job.photo_id.in_(ids)))
        session.execute(delete(Photo).where(Photo.id.in_(ids)))

    photos = select(Photo).where(Photo.map_id == map_id).limit(ROWS_PER_TRANSACTION)
    return delete_with_objects(catalog, store, photos, object_keys, delete_rows)


def _purge_searches(catalog: Catalog, map_id: UUID) -> bool:
    some = select(Search.id).where(Search.map_id == map_id).limit(ROWS_PER_TRANSACTION)
    with catalog.write() as session:
        return affected_rows(session.execute(delete(Search).where(Search.id.in_(some)))) > 0


def _purge_tracks(catalog: Catalog, map_id: UUID) -> bool:
    some = select(Track.id).where(Track.map_id == map_id).limit(TRACKS_PER_TRANSACTION)
    with catalog.write() as session:
        ids = session.scalars(some).all()
        delete_tracks(session, Track.id.in_(ids))
    return bool(ids)


def _purge_vocabulary_objects(catalog: Catalog, store: ObjectStore, map_id: UUID) -> None:
    """Delete the objects of vocabularies, imports, whitenings and uploads of UPLOAD_JOBS.

    Imports may have an object without a vocabulary row. The few rows are deleted by the caller.
    """
    with catalog.read() as session:
        keys = list(
            session.scalars(select(Vocabulary.object_key).where(Vocabulary.map_id == map_id))
        )
        imports = session.scalars(
            select(Job.params).where(
                Job.map_id == map_id, Job.kind.in_((JobKind.IMPORT, *UPLOAD_JOBS))
            )
        )
        keys += [key for params in imports if (key := params["object_key"]) is not None]
        keys += session.scalars(
            select(StoredWhitening.object_key).where(StoredWhitening.map_id == map_id)
        )
    for key in keys:
        store.delete(key)
