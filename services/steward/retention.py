"""What is kept for a while only: finished jobs, the history of searches, the
log of webhooks, idempotency keys."""

from __future__ import annotations

from sqlalchemy import delete, exists, or_, select

from shared.catalog.base import db_now, db_now_plus
from shared.catalog.idempotency import IdempotencyRecord
from shared.catalog.photos import Photo
from shared.catalog.searches import Search
from shared.catalog.session import Catalog
from shared.catalog.webhooks import Delivery
from shared.jobs.table import Job, JobState

RETENTION_ROWS_PER_TRANSACTION = 1000  # rows removed in one transaction
DAY_SECONDS = 86_400.0


def delete_old_jobs(catalog: Catalog, retention_days: float) -> None:
    """Jobs that ended long ago. One that left its photo undescribed stays: it holds the reason, and
    the same bytes again, or a retry, queue it anew."""
    of_a_photo = exists().where(Photo.id == Job.photo_id, Photo.job_id == Job.id)
    old = (
        select(Job.id)
        .where(
            Job.finished_at < db_now_plus(-retention_days * DAY_SECONDS),
            or_(Job.state == JobState.SUCCEEDED, ~of_a_photo),
        )
        .limit(RETENTION_ROWS_PER_TRANSACTION)
        .with_for_update(skip_locked=True)
    )
    with catalog.write() as session:
        session.execute(delete(Job).where(Job.id.in_(session.scalars(old).all())))


def delete_old_searches(catalog: Catalog, history_days: float) -> None:
    """Searches that were asked long ago."""
    old = (
        select(Search.id)
        .where(Search.searched_at < db_now_plus(-history_days * DAY_SECONDS))
        .limit(RETENTION_ROWS_PER_TRANSACTION)
    )
    with catalog.write() as session:
        session.execute(delete(Search).where(Search.id.in_(session.scalars(old).all())))


def delete_old_deliveries(catalog: Catalog, retention_days: float) -> None:
    """The log of what was sent to webhooks. Nothing waits as long as that."""
    old = (
        select(Delivery.id)
        .where(Delivery.created_at < db_now_plus(-retention_days * DAY_SECONDS))
        .limit(RETENTION_ROWS_PER_TRANSACTION)
    )
    with catalog.write() as session:
        session.execute(delete(Delivery).where(Delivery.id.in_(session.scalars(old).all())))


def delete_expired_idempotency_keys(catalog: Catalog) -> None:
    """Idempotency keys whose time is over."""
    old = (
        select(IdempotencyRecord.id)
        .where(IdempotencyRecord.expires_at <= db_now())
        .limit(RETENTION_ROWS_PER_TRANSACTION)
        .with_for_update(skip_locked=True)
    )
    with catalog.write() as session:
        session.execute(
            delete(IdempotencyRecord).where(IdempotencyRecord.id.in_(session.scalars(old).all()))
        )
