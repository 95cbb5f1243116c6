"""Everything that the store holds and the catalog does not know, into the catalog.

Each step looks at what the catalog has already, and commits a little at a time: a run that was
killed is repeated. Of two states of one row the higher revision counts, and a deletion always.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from uuid import UUID

from sqlalchemy import exists, func, insert, select, update
from sqlalchemy.orm import Session

from shared.catalog.base import Condition
from shared.catalog.chunks import Descriptor
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.installation import get_or_create_installation
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.catalog.session import Catalog
from shared.ids import new_id
from shared.jobs.table import Job, JobKind, Priority
from shared.objects import ObjectStore
from shared.rebuild.chunks import take_in_chunks
from shared.rebuild.originals import take_in_originals
from shared.rebuild.rows import RowsTakenIn, take_in_rows
from shared.rebuild.states import AT_ONCE, LastStates, Progress
from shared.settings import Settings


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
