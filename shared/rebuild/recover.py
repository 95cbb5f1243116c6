"""Recovers the catalog from its object store; see `shared.rebuild`.

Each step checks what the catalog already has and commits in small batches, so that an interrupted
run can be repeated. Among several states of a row the highest revision counts, and a deletion
always does.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from uuid import UUID

from sqlalchemy import delete, exists, func, insert, select, update
from sqlalchemy.orm import Session

from shared.backup.folder import backup_tables
from shared.catalog.api_keys import ApiKey
from shared.catalog.chunks import Descriptor
from shared.catalog.database.base import Condition
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.installation import (
    REBUILDING,
    Installation,
    adopt_store,
    get_or_create_installation,
)
from shared.catalog.jobs import Job, JobKind, Priority
from shared.catalog.maps import DEFAULT_MAP, CachedMapStatistics, Map
from shared.catalog.models import Model
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.errors import Conflict, Unavailable
from shared.ids import new_id
from shared.journal.segments import list_segments, read_segment
from shared.rebuild.objects import recover_chunks, recover_originals
from shared.rebuild.rows import (
    ROWS_PER_STATEMENT,
    LatestStates,
    Progress,
    RecoveredRows,
    recover_rows,
)
from shared.storage import ObjectStore, OwnedStore
from shared.storage.ownership import read_owner

# Tables that may have rows after a first start or an interrupted rebuild.
TABLES_WITH_INITIAL_ROWS = {
    table.__tablename__ for table in (ApiKey, Installation, Map, CachedMapStatistics, Model)
}


def begin_rebuild(catalog: Catalog, store: OwnedStore) -> None:
    """Record that a rebuild is running, and adopt the installation id of the store's mark.

    Raises:
        Conflict: `catalog_not_empty` unless the catalog is empty or its rebuild was interrupted.
    """
    mark = read_owner(store)
    owner = UUID(mark) if mark else _journal_installation_id(store)
    with catalog.write() as session:
        installation = get_or_create_installation(session)
        if installation.journal_sequence != REBUILDING:
            _check_empty(session)
            session.execute(delete(CachedMapStatistics))
            session.execute(delete(Map))
            installation.journal_sequence = REBUILDING
        if owner is not None:
            installation.id = owner
    adopt_store(catalog, store)


def _check_empty(session: Session) -> None:
    filled = [
        table.name
        for table in backup_tables()
        if table.name not in TABLES_WITH_INITIAL_ROWS
        and session.execute(select(table).limit(1)).first() is not None
    ]
    if filled or any(name != DEFAULT_MAP for name in session.scalars(select(Map.name))):
        raise Conflict(
            "catalog_not_empty",
            "Only an empty catalog can be rebuilt, and this one has "
            f"{', '.join(filled) or 'maps'}. To recover missing rows, run `placewise verify "
            "--repair`; to rebuild, set a new database (DATABASE_URL) or move catalog.sqlite away.",
        )


def _journal_installation_id(store: ObjectStore) -> UUID | None:
    for segment in reversed(list_segments(store)):
        try:
            return read_segment(store, segment.key).installation_id
        except Unavailable as error:
            if error.code != "journal_damaged":
                raise
    return None


@dataclass(slots=True)
class RecoveryReport(RecoveredRows):
    """What was recovered, and what could not be."""

    chunks: int = 0
    descriptors: int = 0
    damaged_chunks: list[str] = field(default_factory=list)
    unnamed_photos: int = 0
    """Photos that are not in the journal: added to the default map with their EXIF data."""
    unreadable_originals: list[str] = field(default_factory=list)
    unnamed_descriptors: int = 0
    """Rows of chunks whose generations are not in the journal."""
    queued_photos: int = 0
    """Photos without a descriptor, which were queued."""
    damaged_segments: list[str] = field(default_factory=list)


def recover_catalog(
    catalog: Catalog,
    store: ObjectStore,
    settings: Settings,
    *,
    unnamed_age_seconds: float,
    progress: Progress = lambda what, done, total: None,
) -> RecoveryReport:
    """Recover maps, photos, generations with their descriptors, and vocabularies.

    Args:
        settings: extractor of the default map, limits and slot size.
        unnamed_age_seconds: minimum age of originals that are not in the journal; newer ones may
            belong to uploads in progress.

    Raises:
        Unavailable: as the store.
    """
    report = RecoveryReport()
    with LatestStates() as states:
        states.read(store, progress)
        report.damaged_segments = states.damaged
        recover_rows(catalog, store, states, report, progress)
        chunks = recover_chunks(catalog, store, settings.slot_rows, progress)
        report.chunks, report.descriptors = chunks.chunks, chunks.descriptors
        report.damaged_chunks, report.unnamed_descriptors = chunks.damaged, chunks.unnamed_rows
        unnamed = states.unnamed_originals(time.time() - unnamed_age_seconds)
        originals = recover_originals(
            catalog, store, settings, unnamed, chunks.newest_extractor, progress
        )
        report.unnamed_photos, report.unreadable_originals = originals.photos, originals.unreadable
        report.queued_photos = originals.photos + _queue_photos(catalog, progress)
        with catalog.write() as session:
            installation = get_or_create_installation(session)
            installation.journal_sequence = max(installation.journal_sequence, states.sequence)
    return report


def _queue_photos(catalog: Catalog, progress: Progress) -> int:
    """Queue each live photo without a job and without a descriptor in the active generation.

    Returns the number of queued photos.
    """
    described = exists().where(
        Descriptor.photo_id == Photo.id,
        Descriptor.generation_id == Generation.id,
        Generation.map_id == Photo.map_id,
        Generation.state == GenerationState.ACTIVE,
    )
    missing = (
        Photo.deleted_at.is_(None),
        Photo.job_id.is_(None),
        Photo.map_id.in_(select(Map.id).where(Map.deleted_at.is_(None))),
        ~described,
    )
    with catalog.read() as session:
        total = session.scalar(select(func.count()).select_from(Photo).where(*missing)) or 0
    done, last = 0, UUID(int=0)
    while True:
        queued = catalog.run(partial(_queue_batch, missing=(*missing, Photo.id > last)))
        if not queued:
            return done
        done, last = done + len(queued), queued[-1]
        progress("photos to describe", done, total)


def _queue_batch(session: Session, missing: Sequence[Condition]) -> list[UUID]:
    """Queue a batch of these photos, ordered by id; return their ids."""
    photos = session.execute(
        select(Photo.id, Photo.map_id).where(*missing).order_by(Photo.id).limit(ROWS_PER_STATEMENT)
    ).all()
    if not photos:
        return []
    jobs = [
        {
            "id": new_id(),
            "map_id": photo.map_id,
            "kind": JobKind.INDEX,
            "priority": Priority.UPLOAD,
            "photo_id": photo.id,
        }
        for photo in photos
    ]
    session.execute(insert(Job), jobs)
    session.execute(update(Photo), [{"id": job["photo_id"], "job_id": job["id"]} for job in jobs])
    return [photo.id for photo in photos]
