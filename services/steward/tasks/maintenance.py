"""Short maintenance tasks: expired leases, lost wakeups, retention, cached map statistics.

Retention covers finished jobs, the search history, tracks, webhook deliveries and idempotency keys.
"""

from __future__ import annotations

import logging
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, delete, exists, or_, select
from sqlalchemy.orm import InstrumentedAttribute

from services.steward.periodic_tasks import periodic_task
from shared.catalog.database.base import db_now, db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.idempotency import StoredResponse
from shared.catalog.jobs import Job, JobState
from shared.catalog.maps import (
    CachedMapStatistics,
    Search,
    are_statistics_stale,
    cache_map_statistics,
    is_large_map,
    list_maps,
)
from shared.catalog.photos import Photo
from shared.catalog.tracks import RETENTION_DAYS, Track, delete_tracks
from shared.catalog.webhooks import Delivery
from shared.config.settings import Settings
from shared.jobs import Wakeups
from shared.jobs.runner import reclaim_expired_leases
from shared.jobs.wakeups import report_jobs

log = logging.getLogger(__name__)


@periodic_task(1.0, counter="leases_expired")
def reclaim_leases(catalog: Catalog, wakeups: Wakeups, *, all_leases: bool = False) -> int:
    """Requeue or fail the jobs of dead workers; see `reclaim_expired_leases`."""
    with catalog.write() as session:
        reclaimed = reclaim_expired_leases(session, all_leases=all_leases)
    if reclaimed:
        log.warning("reclaimed %d jobs of workers that died", len(reclaimed))
        report_jobs(catalog, wakeups, [job.id for job in reclaimed])
    return len(reclaimed)


@periodic_task(2.0, counter="wakeups_resent")
def resend_wakeups(catalog: Catalog, wakeups: Wakeups) -> int:
    """Send the messages of jobs whose first one was lost; see `Wakeups.resend`."""
    return wakeups.resend(catalog)


RETENTION_ROWS_PER_TRANSACTION = 1000  # rows deleted in one transaction
TRACKS_PER_TRANSACTION = 10  # each has up to MAX_TRACK_FRAMES rows
DAY_SECONDS = 86_400.0
JOB_RETENTION_DAYS = 30.0  # also of webhook deliveries


@periodic_task(10.0)
def delete_old_jobs(catalog: Catalog) -> None:
    """Delete jobs that ended more than JOB_RETENTION_DAYS ago.

    An unsuccessful job that is its photo's current job stays: it has the reason why the photo is
    not described, and a retry or another upload of the same bytes queues it again.
    """
    is_current_of_photo = exists().where(Photo.id == Job.photo_id, Photo.job_id == Job.id)
    is_over = or_(Job.state == JobState.SUCCEEDED, ~is_current_of_photo)
    is_old = Job.finished_at < _days_ago(JOB_RETENTION_DAYS)
    _delete_rows(catalog, Job.id, is_old, is_over)


@periodic_task(10.0)
def delete_old_searches(catalog: Catalog, settings: Settings) -> None:
    """Delete searches from the history that are older than SEARCH_HISTORY_DAYS."""
    is_old = Search.searched_at < _days_ago(settings.search_history_days)
    _delete_rows(catalog, Search.id, is_old)


@periodic_task(10.0)
def delete_old_tracks(catalog: Catalog) -> None:
    """Delete tracks without a new frame for RETENTION_DAYS."""
    old = (
        select(Track.id)
        .where(Track.updated_at < _days_ago(RETENTION_DAYS))
        .limit(TRACKS_PER_TRANSACTION)
        .with_for_update(skip_locked=True)
    )
    with catalog.write() as session:
        delete_tracks(session, Track.id.in_(session.scalars(old).all()))


@periodic_task(10.0)
def delete_old_deliveries(catalog: Catalog) -> None:
    """Delete webhook deliveries older than JOB_RETENTION_DAYS: retries end long before that."""
    is_old = Delivery.created_at < _days_ago(JOB_RETENTION_DAYS)
    _delete_rows(catalog, Delivery.id, is_old)


@periodic_task(10.0)
def delete_expired_idempotency_keys(catalog: Catalog) -> None:
    _delete_rows(catalog, StoredResponse.id, StoredResponse.expires_at <= db_now())


def _days_ago(days: float) -> ColumnElement[datetime]:
    return db_now_plus(-days * DAY_SECONDS)


def _delete_rows(
    catalog: Catalog, ids: InstrumentedAttribute[Any], *conditions: ColumnElement[bool]
) -> None:
    """Delete up to RETENTION_ROWS_PER_TRANSACTION rows; locked ones are left to the next run."""
    chosen = select(ids).where(*conditions).limit(RETENTION_ROWS_PER_TRANSACTION)
    with catalog.write() as session:
        found = session.scalars(chosen.with_for_update(skip_locked=True)).all()
        session.execute(delete(ids.class_).where(ids.in_(found)))


@periodic_task(10.0, own_thread=True)
def update_statistics_of_large_maps(catalog: Catalog) -> None:
    """Refresh the cached statistics of each map that is too large to be counted per request.

    Those of maps that are no longer so large, or were deleted, are deleted.
    """
    with catalog.read() as session:
        maps = [map_.id for map_ in list_maps(session)]
        large = {map_id for map_id in maps if is_large_map(session, map_id)}
        due = [map_id for map_id in large if are_statistics_stale(session, map_id)]
        cached = set(session.scalars(select(CachedMapStatistics.map_id)))
    for map_id in due:
        with catalog.write() as session:
            cache_map_statistics(session, map_id)
    if outdated := cached - large:
        with catalog.write() as session:
            is_outdated = CachedMapStatistics.map_id.in_(outdated)
            session.execute(delete(CachedMapStatistics).where(is_outdated))
