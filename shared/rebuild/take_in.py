"""Making an empty catalog the owner of a store that another catalog has filled.

Everything that the store holds and the catalog does not know, into the catalog.

Each step looks at what the catalog has already, and commits a little at a time: a run that was
killed is repeated. Of two states of one row the higher revision counts, and a deletion always.
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
from shared.catalog.base import Condition
from shared.catalog.chunks import Descriptor
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
from shared.catalog.session import Catalog
from shared.config.settings import Settings
from shared.errors import Conflict, Unavailable
from shared.ids import new_id
from shared.journal.segments import list_segments, read_segment
from shared.rebuild.objects import take_in_chunks, take_in_originals
from shared.rebuild.rows import AT_ONCE, LastStates, Progress, RowsTakenIn, take_in_rows
from shared.storage import ObjectStore, OwnedStore
from shared.storage.ownership import read_owner

# What a first start, or an interrupted rebuild, may have left.
MAY_HAVE_ROWS = {
    table.__tablename__ for table in (ApiKey, Installation, Map, CachedMapStatistics, Model)
}


def begin_rebuild(catalog: Catalog, store: OwnedStore) -> None:
    """Note that a rebuild is under way, and take over the id that the store is marked with.

    Raises Conflict (`catalog_not_empty`) unless the catalog is empty, or a rebuild of it was
    interrupted.
    """
    mark = read_owner(store)
    owner = UUID(mark) if mark else _writer_of_journal(store)
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
        if table.name not in MAY_HAVE_ROWS
        and session.execute(select(table).limit(1)).first() is not None
    ]
    if filled or any(name != DEFAULT_MAP for name in session.scalars(select(Map.name))):
        raise Conflict(
            "catalog_not_empty",
            "Only an empty catalog is rebuilt, and this one holds "
            f"{', '.join(filled) or 'maps'}. `placewise verify --repair` brings what is missing "
            "into it; or give a new database (DATABASE_URL), or move catalog.sqlite away.",
        )


def _writer_of_journal(store: ObjectStore) -> UUID | None:
    for segment in reversed(list_segments(store)):
        try:
            return read_segment(store, segment.key).installation_id
        except Unavailable as error:
            if error.code != "journal_damaged":
                raise
    return None


@dataclass(slots=True)
class TakenIn(RowsTakenIn):
    """What came into the catalog, and what could not."""

    chunks: int = 0
    descriptors: int = 0
    damaged_chunks: list[str] = field(default_factory=list)
    unnamed_photos: int = 0
    """Photos that no journal names: the default map has them, with what EXIF says."""
    unreadable_originals: list[str] = field(default_factory=list)
    unnamed_descriptors: int = 0
    """Rows of chunks of generations that the journal does not know."""
    queued_photos: int = 0
    """Photos without a descriptor: they are described again."""
    damaged_segments: list[str] = field(default_factory=list)


def take_in(
    catalog: Catalog,
    store: ObjectStore,
    settings: Settings,
    *,
    unnamed_age_seconds: float,
    progress: Progress = lambda what, done, total: None,
) -> TakenIn:
    """Bring maps, photos, generations with their descriptors, and vocabularies into the catalog.

    Originals that the journal does not name are taken in when they are older than
    `unnamed_age_seconds`: others may belong to uploads that are under way. Raises Unavailable as
    the store does.
    """
    taken = TakenIn()
    with LastStates() as states:
        states.read(store, progress)
        taken.damaged_segments = states.damaged
        take_in_rows(catalog, store, states, taken, progress)
        found = take_in_chunks(catalog, store, settings.slot_rows, progress)
        taken.chunks, taken.descriptors = found.chunks, found.descriptors
        taken.damaged_chunks, taken.unnamed_descriptors = found.damaged, found.unnamed_rows
        unnamed = states.unnamed_originals(time.time() - unnamed_age_seconds)
        originals = take_in_originals(
            catalog, store, settings, unnamed, found.newest_extractor, progress
        )
        taken.unnamed_photos, taken.unreadable_originals = originals.photos, originals.unreadable
        taken.queued_photos = originals.photos + _queue_photos(catalog, progress)
        with catalog.write() as session:
            installation = get_or_create_installation(session)
            installation.journal_sequence = max(installation.journal_sequence, states.sequence)
    return taken


def _queue_photos(catalog: Catalog, progress: Progress) -> int:
    """An index job for each live photo that has neither a job nor a descriptor in the generation
    that answers; how many."""
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
        queued = catalog.run(partial(_queue_some, missing=(*missing, Photo.id > last)))
        if not queued:
            return done
        done, last = done + len(queued), queued[-1]
        progress("photos to describe", done, total)


def _queue_some(session: Session, missing: Sequence[Condition]) -> list[UUID]:
    """Queue the first of these photos by id; their ids."""
    photos = session.execute(
        select(Photo.id, Photo.map_id).where(*missing).order_by(Photo.id).limit(AT_ONCE)
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
