"""Rebuilds a catalog from its object store: from journal, chunk manifests and originals.

Each step skips what the catalog has and commits in small batches, so that an interrupted run can be
repeated. Until it has finished, nothing else uses the catalog (`check_not_behind`).
"""

from __future__ import annotations

from uuid import UUID

from sqlalchemy import delete, exists, insert, select, update
from sqlalchemy.orm import Session

from services.cli.recovery.journal_rows import (
    ROWS_PER_STATEMENT,
    LatestStates,
    Progress,
    RecoveryReport,
    recover_rows,
    recover_snapshot,
)
from services.cli.recovery.objects import recover_chunks, recover_originals
from shared.catalog.api_keys import ApiKey
from shared.catalog.chunks import Descriptor
from shared.catalog.database.base import Base
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.installation import (
    REBUILDING,
    Installation,
    adopt_store,
    get_or_create_installation,
)
from shared.catalog.jobs import Job, JobKind
from shared.catalog.maps import DEFAULT_MAP, CachedMapStatistics, Map
from shared.catalog.models import Model
from shared.catalog.photos import Photo
from shared.catalog.processes import RegisteredProcess
from shared.config.settings import Settings
from shared.errors import Conflict
from shared.ids import new_id
from shared.storage import ObjectStore, OwnedStore

# Tables that may have rows after a first start.
TABLES_WITH_INITIAL_ROWS = {
    table.__tablename__
    for table in (ApiKey, Installation, Map, CachedMapStatistics, Model, RegisteredProcess)
}


def begin_rebuild(catalog: Catalog, store: OwnedStore, installation_id: UUID | None) -> None:
    """Record that a rebuild is running, and make the catalog the owner of the store.

    Args:
        installation_id: id of the catalog that was lost; None if the store has no mark.

    Raises:
        Conflict: `catalog_not_empty` unless the catalog is empty or its rebuild was interrupted.
    """
    with catalog.write() as session:
        installation = get_or_create_installation(session)
        if installation.journal_sequence != REBUILDING:
            _check_empty(session)
            for table in (CachedMapStatistics, Map):
                session.execute(delete(table))
            installation.journal_sequence = REBUILDING
        if installation_id is not None:
            installation.id = installation_id
    adopt_store(catalog, store)


def _check_empty(session: Session) -> None:
    filled = [
        table.name
        for table in Base.metadata.sorted_tables
        if table.name not in TABLES_WITH_INITIAL_ROWS
        and session.execute(select(table).limit(1)).first() is not None
    ]
    if filled or any(name != DEFAULT_MAP for name in session.scalars(select(Map.name))):
        raise Conflict(
            "catalog_not_empty",
            "Only an empty catalog can be rebuilt, and this one has "
            f"{', '.join(filled) or 'maps'}. Set a new database (DATABASE_URL), or move "
            "catalog.sqlite and its -wal and -shm files away.",
        )


def rebuild_catalog(
    catalog: Catalog,
    store: ObjectStore,
    settings: Settings,
    *,
    with_unnamed: bool,
    progress: Progress = lambda what, done, total: None,
) -> RecoveryReport:
    """Recover everything that the object store has, after `begin_rebuild`.

    Args:
        settings: extractor of the default map, and limits.
        with_unnamed: whether to add originals that are not in the journal to the default map.

    Raises:
        Unavailable: as the store.
    """
    report = RecoveryReport()
    with LatestStates() as states:
        states.read(store, progress)
        recover_rows(catalog, store, states, report, progress)
        recover_chunks(catalog, store, report, progress)
        recover_snapshot(catalog, store, states, progress)
        if with_unnamed:
            unnamed = states.unnamed_originals()
            recover_originals(catalog, store, settings, unnamed, report, progress)
        report.queued_photos = report.unnamed_photos + _queue_photos(catalog, progress)
        with catalog.write() as session:
            get_or_create_installation(session).journal_sequence = states.sequence
    return report


def _queue_photos(catalog: Catalog, progress: Progress) -> int:
    """Queue the photos that have neither a job nor a descriptor in the active generation.

    Their jobs have the ids that they had. Returns the number of queued photos.
    """
    described = exists().where(
        Descriptor.photo_id == Photo.id,
        Descriptor.generation_id == Generation.id,
        Generation.map_id == Photo.map_id,
        Generation.state == GenerationState.ACTIVE,
    )
    has_job = exists().where(Job.id == Photo.job_id)
    missing = (
        select(Photo.id, Photo.map_id, Photo.job_id)
        .where(~has_job, ~described, Photo.deleted_at.is_(None))
        .order_by(Photo.id)
        .limit(ROWS_PER_STATEMENT)
    )
    queued, last = 0, UUID(int=0)
    while True:
        with catalog.write() as session:
            photos = session.execute(missing.where(Photo.id > last)).all()
            if not photos:
                return queued
            jobs = [
                {
                    "id": photo.job_id or new_id(),
                    "map_id": photo.map_id,
                    "kind": JobKind.INDEX,
                    "photo_id": photo.id,
                }
                for photo in photos
            ]
            session.execute(insert(Job), jobs)
            session.execute(
                update(Photo),
                [
                    {"id": job["photo_id"], "job_id": job["id"]}
                    for job, photo in zip(jobs, photos, strict=True)
                    if photo.job_id is None
                ],
            )
        queued, last = queued + len(photos), photos[-1].id
        progress("photos to describe", queued, queued)
