"""Garbage collection: deletes objects and rows that the catalog no longer needs.

Each function handles up to ROWS_PER_TRANSACTION rows of one kind. It deletes the objects first and
their rows afterwards: after a crash in between the deletion is repeated, which is harmless, while
the opposite order would leave objects that no row refers to. Objects without rows are collected in
`services.steward.tasks.orphans`.

The journal has to record the deletion of a photo or a map before its objects are deleted, or a
catalog rebuilt from it would restore the row.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

from sqlalchemy import Select, and_, delete, exists, or_, select, update
from sqlalchemy.orm import Session, aliased

from services.steward.periodic_tasks import periodic_task
from services.steward.tasks.reindex_jobs import delete_done_reindex_jobs, settle_photo_jobs
from shared.catalog.chunks import Chunk, Descriptor, delete_chunk_rows
from shared.catalog.database.base import Condition, db_now, db_now_plus, is_journaled
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import QUERY_TTL_SECONDS, UNFINISHED_STATES, UPLOAD_JOBS, Job, JobKind
from shared.catalog.maps import Map, increment_map_version, lock_map
from shared.catalog.photos import Photo
from shared.catalog.reconstructions import Reconstruction
from shared.catalog.tracks import TrackFrame, is_pending
from shared.catalog.vocabularies import StoredWhitening
from shared.errors import Unavailable
from shared.journal.outbox import write_journal
from shared.storage import ObjectStore
from shared.storage.chunks import delete_chunk
from shared.storage.keys import CHECKPOINTS, derived_image_keys, query_object_keys

log = logging.getLogger(__name__)

T = TypeVar("T")

SUPERSEDED_GRACE_SECONDS = 600.0  # search reads a merged chunk until it has loaded the new one
RETIRED_GRACE_SECONDS = 3600.0  # the same of a replaced generation, and time to switch back
ROWS_PER_TRANSACTION = 500  # rows handled in one transaction
# A full object store accepts no journal segment, and only deletions free space. A photo that is
# deleted before the journal records it does not come back either: without its original it is not
# rebuilt.
MAX_JOURNAL_WAIT_SECONDS = 60.0


def delete_with_objects(
    catalog: Catalog,
    store: ObjectStore,
    rows: Select[T],
    object_keys: Callable[[T], Iterable[str]],
    delete_rows: Callable[[Session, Sequence[T]], object],
) -> bool:
    """Delete the objects of the selected rows, then the rows in one transaction.

    Returns:
        Whether there were any rows.
    """
    with catalog.read() as session:
        found = session.scalars(rows).all()
    for row in found:
        for key in object_keys(row):
            store.delete(key)
    if found:
        with catalog.write() as session:
            delete_rows(session, found)
    return bool(found)


def journal_deletions(catalog: Catalog, store: ObjectStore, table: type[Photo] | type[Map]) -> None:
    """Write the journal if it lacks deletions of the table; log a warning if the store refuses."""
    pending = select(table.id).where(table.deleted_at.is_not(None), ~is_journaled(table))
    with catalog.read() as session:
        if session.scalar(pending.limit(1)) is None:
            return
    try:
        write_journal(catalog, store)
    except Unavailable as error:
        log.warning("deletions could not be written to the journal: %s", error)


def deletion_is_journaled(table: type[Photo] | type[Map]) -> Condition:
    """Condition for deleted rows whose objects may be deleted: the journal records the deletion, or
    could not be written for MAX_JOURNAL_WAIT_SECONDS."""
    return or_(is_journaled(table), table.deleted_at < db_now_plus(-MAX_JOURNAL_WAIT_SECONDS))


def delete_chunks(
    catalog: Catalog,
    store: ObjectStore,
    *conditions: Condition,
    limit: int = ROWS_PER_TRANSACTION,
) -> bool:
    """Delete chunks with their objects and descriptors; return whether there were any.

    The conditions may refer to the chunk's generation.
    """
    with catalog.read() as session:
        chunks = session.scalars(
            select(Chunk)
            .join(Generation, Generation.id == Chunk.generation_id)
            .where(*conditions)
            .limit(limit)
        ).all()
    for chunk in chunks:
        delete_chunk(store, chunk.object_key)
        with catalog.write() as session:
            delete_chunk_rows(session, chunk.id)
    return bool(chunks)


def collect_superseded_chunks(catalog: Catalog, store: ObjectStore, grace_seconds: float) -> None:
    """Delete chunks that were merged into others, after a grace period for running queries."""
    delete_chunks(catalog, store, Chunk.superseded_at < db_now_plus(-grace_seconds))


def collect_ended_generations(catalog: Catalog, store: ObjectStore, grace_seconds: float) -> None:
    """Delete the data of generations that were retired or abandoned `grace_seconds` ago.

    Deletes their descriptors and chunks, and the reindex jobs of abandoned ones. The generation's
    own row stays as history until its map is deleted.
    """
    ended_long_ago = Generation.ended_at < db_now_plus(-grace_seconds)
    of_abandoned = (
        select(Job.id)
        .join(Generation, Generation.id == Job.generation_id)
        .where(
            Job.kind == JobKind.REINDEX,
            Generation.state == GenerationState.ABANDONED,
            ended_long_ago,
        )
        .limit(ROWS_PER_TRANSACTION)
    )
    with catalog.read() as session:
        job_ids = session.scalars(of_abandoned).all()
    if job_ids:
        with catalog.write() as session:
            session.execute(delete(Job).where(Job.id.in_(job_ids)))
    is_over = Generation.state.in_((GenerationState.RETIRED, GenerationState.ABANDONED))
    delete_chunks(catalog, store, is_over, ended_long_ago)


def collect_whitenings(catalog: Catalog, store: ObjectStore, grace_seconds: float) -> None:
    """Delete PCA whitenings whose generations have all ended: no model change uses one again."""
    in_use = exists().where(
        Generation.whitening_id == StoredWhitening.id,
        or_(Generation.ended_at.is_(None), Generation.ended_at >= db_now_plus(-grace_seconds)),
    )

    def delete_rows(session: Session, whitenings: Sequence[StoredWhitening]) -> None:
        ids = [whitening.id for whitening in whitenings]
        session.execute(
            update(Generation)
            .where(Generation.whitening_id.in_(ids))
            .values(whitening_id=None)
            .execution_options(synchronize_session=False)
        )
        session.execute(delete(StoredWhitening).where(StoredWhitening.id.in_(ids)))

    ended = select(StoredWhitening).where(~in_use).limit(ROWS_PER_TRANSACTION)
    delete_with_objects(
        catalog, store, ended, lambda whitening: [whitening.object_key], delete_rows
    )


def collect_reconstructions(catalog: Catalog, store: ObjectStore, grace_seconds: float) -> None:
    """Delete reconstructions that were replaced `grace_seconds` ago, or whose job ended without it.

    One of other local features stays: the map may switch back to them.
    """
    newer, long_ago = aliased(Reconstruction), db_now_plus(-grace_seconds)
    was_replaced = exists().where(
        newer.map_id == Reconstruction.map_id,
        newer.features_model == Reconstruction.features_model,
        newer.id > Reconstruction.id,
        newer.finished_at < long_ago,
    )
    may_continue = exists().where(
        Job.id == Reconstruction.job_id,
        or_(Job.state.in_(UNFINISHED_STATES), Job.finished_at >= long_ago),
    )
    is_finished = Reconstruction.finished_at.is_not(None)
    over = select(Reconstruction).where(
        or_(and_(is_finished, was_replaced), and_(~is_finished, ~may_continue))
    )
    delete_reconstructions(catalog, store, over)


def delete_reconstructions(
    catalog: Catalog, store: ObjectStore, selected: Select[Reconstruction]
) -> bool:
    """Delete the selected reconstructions with their objects; return whether there were any."""
    return delete_with_objects(
        catalog,
        store,
        selected.limit(ROWS_PER_TRANSACTION),
        lambda reconstruction: reconstruction.list_object_keys(store),
        lambda session, rows: session.execute(
            delete(Reconstruction).where(Reconstruction.id.in_(row.id for row in rows))
        ),
    )


def collect_deleted_photos(catalog: Catalog, store: ObjectStore, grace_seconds: float) -> None:
    """Delete the objects of deleted photos at `purge_at`, and their rows after `grace_seconds`.

    The objects (original, thumbnail, preview) stay until the journal has recorded the deletion.
    After the grace period every search worker has seen the deletion and compaction has dropped the
    descriptors and local features.
    """
    journal_deletions(catalog, store, Photo)
    with catalog.read() as session:
        photos = session.scalars(
            select(Photo)
            .where(
                Photo.deleted_at.is_not(None),
                Photo.purge_at <= db_now(),
                Photo.object_key != "",
                deletion_is_journaled(Photo),
            )
            .limit(ROWS_PER_TRANSACTION)
        ).all()
    for photo in photos:
        store.delete(photo.object_key)
        for key in derived_image_keys(photo.id):
            store.delete(key)
    photo_ids = [photo.id for photo in photos]
    with catalog.write() as session:
        if photo_ids:
            session.execute(
                update(Photo)
                .where(Photo.id.in_(photo_ids))
                # Sets the revision explicitly: otherwise the journal would record a change.
                .values(object_key="", revision=Photo.revision)
            )
        _delete_photo_rows(session, grace_seconds)


def _delete_photo_rows(session: Session, grace_seconds: float) -> None:
    photos = session.execute(
        select(Photo.id, Photo.map_id)
        .where(
            Photo.deleted_at < db_now_plus(-grace_seconds),
            Photo.object_key == "",
            is_journaled(Photo),
        )
        .limit(ROWS_PER_TRANSACTION)
    ).all()
    photo_ids = [photo_id for photo_id, _ in photos]
    if not photo_ids:
        return
    for map_id in sorted({map_id for _, map_id in photos}):
        lock_map(session, map_id)
        # Search workers that lag far behind load their chunks again.
        increment_map_version(session, map_id)
    session.execute(delete(Descriptor).where(Descriptor.photo_id.in_(photo_ids)))
    session.execute(delete(Job).where(Job.photo_id.in_(photo_ids)))
    session.execute(delete(Photo).where(Photo.id.in_(photo_ids)))


def delete_queries(catalog: Catalog, store: ObjectStore, *conditions: Condition) -> bool:
    """Delete query jobs with their photos and descriptors; return whether there were any."""
    return delete_with_objects(
        catalog,
        store,
        select(Job.id).where(Job.kind == JobKind.DESCRIBE, *conditions).limit(ROWS_PER_TRANSACTION),
        query_object_keys,
        lambda session, ids: session.execute(delete(Job).where(Job.id.in_(ids))),
    )


def collect_queries(catalog: Catalog, store: ObjectStore, ttl_seconds: float) -> None:
    """Delete queries after QUERY_TTL.

    Jobs of pending frames stay until their frame is applied, or the track is deleted.
    """
    awaited_by_frame = exists().where(TrackFrame.job_id == Job.id, is_pending())
    is_old = Job.created_at < db_now_plus(-ttl_seconds)
    delete_queries(catalog, store, is_old, ~awaited_by_frame)


def collect_checkpoints(catalog: Catalog, store: ObjectStore) -> None:
    """Delete uploaded checkpoints and COLMAP models whose jobs have ended.

    A checkpoint that no job refers to stays: its upload may still be running.
    """
    keys = [info.key for info in store.list(CHECKPOINTS)]
    if not keys:
        return
    with catalog.read() as session:
        ended = session.scalars(
            select(Job.params).where(Job.kind.in_(UPLOAD_JOBS), Job.state.not_in(UNFINISHED_STATES))
        )
        ended_keys = {params["object_key"] for params in ended}
    for key in keys:
        if key in ended_keys:
            store.delete(key)


@periodic_task(10.0, own_thread=True)
def collect_garbage(
    catalog: Catalog,
    store: ObjectStore,
    *,
    query_ttl_seconds: float = QUERY_TTL_SECONDS,
    superseded_grace_seconds: float = SUPERSEDED_GRACE_SECONDS,
    retired_grace_seconds: float = RETIRED_GRACE_SECONDS,
) -> None:
    """Run every collection of this module once, and complete the switch to new generations."""
    settle_photo_jobs(catalog)
    delete_done_reindex_jobs(catalog)
    collect_superseded_chunks(catalog, store, superseded_grace_seconds)
    collect_ended_generations(catalog, store, retired_grace_seconds)
    collect_whitenings(catalog, store, retired_grace_seconds)
    collect_reconstructions(catalog, store, retired_grace_seconds)
    collect_deleted_photos(catalog, store, retired_grace_seconds)
    collect_queries(catalog, store, query_ttl_seconds)
    collect_checkpoints(catalog, store)
