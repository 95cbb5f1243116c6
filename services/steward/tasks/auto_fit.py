"""Automatic vocabulary fits: improves maps with a vocabulary of their own photos.

A fit starts when the map has the number of photos of `next_fit_photos`, and no upload is under way:
a bulk upload would otherwise be described again at 50, 100, 200 and more photos.
"""

from __future__ import annotations

import logging
from uuid import UUID

from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from services.steward.periodic_tasks import periodic_task
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import UNFINISHED_STATES
from shared.catalog.maps import Map, has_database_photos, list_maps, lock_map
from shared.catalog.photos import Photo
from shared.catalog.vocabularies import next_fit_photos
from shared.extractor_config.configs import DEFAULT_SAMPLE_PHOTOS
from shared.jobs import Job, JobKind, Wakeups
from shared.jobs.model_changes import get_unfinished_model_change, start_model_change
from shared.jobs.wakeups import JobMessage

log = logging.getLogger(__name__)

# The defaults of `POST /vocabularies`; without `clusters` the extractor's own number is used.
DEFAULT_FIT_PARAMS = {"clusters": None, "sample": DEFAULT_SAMPLE_PHOTOS, "seed": 0}

# An upload is under way until no photo has arrived for so long ...
QUIET_SECONDS = 5.0
# ... but a map that has so many times the photos does not wait: a camera may never pause.
OVERDUE_FACTOR = 4


@periodic_task(2.0)
def fit_due_vocabularies(catalog: Catalog, wakeups: Wakeups) -> bool:
    """Start a vocabulary fit for each map that is due.

    Returns:
        Whether a map is due but for photos that arrived less than QUIET_SECONDS ago.
    """
    with catalog.read() as session:
        due = [map_.id for map_ in list_maps(session) if is_fit_due(session, map_)]
        settled = [map_id for map_id in due if not _has_arrivals(session, map_id)]
    for map_id in settled:
        with catalog.write() as session:
            map_ = lock_map(session, map_id)
            if not is_fit_due(session, map_):
                continue  # another steward has started the fit
            job = start_model_change(session, map_id, JobKind.FIT, dict(DEFAULT_FIT_PARAMS))
            message = JobMessage.of(job, map_.name)
        log.info(
            "fitting a vocabulary for map %s, which has enough photos (job %s)", map_id, job.id
        )
        wakeups.send(message)
    return len(settled) < len(due)


def is_fit_due(session: Session, map_: Map) -> bool:
    """Return whether the map has enough photos, and none of them waits to be described."""
    photos = next_fit_photos(session, map_)
    return (
        photos is not None
        and has_database_photos(session, map_.id, photos)
        and get_unfinished_model_change(session, map_.id) is None
        and not _has_queued_photos(session, map_.id)
    )


def _has_queued_photos(session: Session, map_id: UUID) -> bool:
    queued = exists().where(
        Job.map_id == map_id,
        Job.kind.in_((JobKind.INDEX, JobKind.BATCH)),
        Job.state.in_(UNFINISHED_STATES),
    )
    return bool(session.scalar(select(queued)))


def _has_arrivals(session: Session, map_id: UUID) -> bool:
    """Return whether photos have just arrived in a map that is not overdue."""
    arrived = exists().where(
        Photo.map_id == map_id, Photo.uploaded_at > db_now_plus(-QUIET_SECONDS)
    )
    if not session.scalar(select(arrived)):
        return False
    photos = next_fit_photos(session, session.get_one(Map, map_id))
    return photos is None or not has_database_photos(session, map_id, OVERDUE_FACTOR * photos)
