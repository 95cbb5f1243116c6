"""Webhooks and the transactional outbox of their events.

An event is written in the transaction that causes it (`enqueue_event`), as one delivery per
subscribed webhook: no event is lost, and none is sent for a transaction that was rolled back. The
steward sends the deliveries (`services.steward.webhooks`).
"""

from __future__ import annotations

import base64
import json
import secrets
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any
from uuid import UUID

from sqlalchemy import Index, Integer, String, Text, Uuid, delete, select
from sqlalchemy.orm import Mapped, Session, mapped_column

from shared.catalog.database.base import (
    Entity,
    Journaled,
    JsonValue,
    UtcDateTime,
    db_now,
    insert_row,
    partial_index,
)
from shared.errors import NotFound
from shared.ids import new_id

SECRET_PREFIX = "whsec_"  # noqa: S105  (the Standard Webhooks form of a secret)
SECRET_BYTES = 32


class EventKind(StrEnum):
    JOB_SUCCEEDED = "job.succeeded"
    JOB_FAILED = "job.failed"
    BATCH_FINISHED = "batch.finished"  # in addition to the batch's job.succeeded or job.failed
    GENERATION_SWITCHED = "generation.switched"


class DeliveryState(StrEnum):
    PENDING = "pending"  # next attempt at `next_attempt_at`
    DELIVERED = "delivered"  # got a 2xx response
    FAILED = "failed"  # no more attempts


class Webhook(Journaled, Entity):
    """A webhook. Its secret signs the events, so it is stored in plain text, also in the journal.

    A deleted one keeps its row, without the secret: the journal records its deletion.
    """

    __tablename__ = "webhooks"

    url: Mapped[str] = mapped_column(Text)
    events: Mapped[list[str]] = mapped_column(JsonValue)
    secret: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    deleted_at: Mapped[datetime | None] = mapped_column(UtcDateTime)


class Delivery(Entity):
    """One event for one webhook.

    It has no foreign key to the webhook, because the deletion of a webhook must not block the
    extractors' transactions, which write events. Deliveries of a deleted webhook are never sent.
    """

    __tablename__ = "webhook_deliveries"

    webhook_id: Mapped[UUID] = mapped_column(Uuid)
    event_id: Mapped[UUID] = mapped_column(Uuid)  # the same for all attempts and webhooks
    event: Mapped[EventKind] = mapped_column(String(50))
    body: Mapped[str] = mapped_column(Text)  # JSON, exactly as it is signed
    state: Mapped[DeliveryState] = mapped_column(String(20), default=DeliveryState.PENDING)
    attempts: Mapped[int] = mapped_column(Integer, default=0)
    next_attempt_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    last_status: Mapped[int | None] = mapped_column(Integer)
    last_error: Mapped[str | None] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())
    ended_at: Mapped[datetime | None] = mapped_column(UtcDateTime)

    __table_args__ = (
        partial_index(
            "ix_webhook_deliveries_due", "next_attempt_at", only=state == DeliveryState.PENDING
        ),
        Index("ix_webhook_deliveries_webhook", "webhook_id", "id"),
        Index("ix_webhook_deliveries_created_at", "created_at"),
    )


def create_webhook(session: Session, url: str, events: list[EventKind]) -> Webhook:
    """Create a webhook with a new secret.

    The caller has checked the `url` with `shared.security.webhook_targets`.
    """
    secret = SECRET_PREFIX + base64.b64encode(secrets.token_bytes(SECRET_BYTES)).decode()
    webhook = Webhook(url=url, events=sorted(set(events)), secret=secret)
    session.refresh(insert_row(session, webhook))
    return webhook


def get_webhook(session: Session, webhook_id: UUID) -> Webhook:
    """Return a webhook; NotFound (`webhook_not_found`)."""
    webhook = session.get(Webhook, webhook_id)
    if webhook is None or webhook.deleted_at is not None:
        raise NotFound("webhook_not_found", f"There is no webhook {webhook_id}.")
    return webhook


def delete_webhook(session: Session, webhook_id: UUID) -> Webhook:
    """Delete a webhook with all its deliveries, also pending ones; NotFound."""
    webhook = get_webhook(session, webhook_id)
    session.execute(delete(Delivery).where(Delivery.webhook_id == webhook_id))
    webhook.secret, webhook.deleted_at = "", db_now()
    return webhook


def subscribed_webhook_ids(session: Session, event: EventKind) -> list[UUID]:
    """Return the ids of the webhooks subscribed to the event, read once per transaction."""
    webhooks = session.info.get("webhooks")
    if webhooks is None:
        # The caller's changes may be incomplete, so they must not be flushed here.
        with session.no_autoflush:
            live = select(Webhook.id, Webhook.events).where(Webhook.deleted_at.is_(None))
            webhooks = session.execute(live).all()
        session.info["webhooks"] = webhooks
    return [webhook_id for webhook_id, events in webhooks if event in events]


def enqueue_event(session: Session, event: EventKind, data: dict[str, Any]) -> None:
    """Write a delivery of the event for each subscribed webhook, to be sent after the commit."""
    webhook_ids = subscribed_webhook_ids(session, event)
    if not webhook_ids:
        return
    event_id = new_id()
    payload = {"type": event, "timestamp": datetime.now(UTC).isoformat(), "data": data}
    body = json.dumps(payload, separators=(",", ":"))
    session.add_all(
        Delivery(webhook_id=webhook_id, event_id=event_id, event=event, body=body)
        for webhook_id in webhook_ids
    )
