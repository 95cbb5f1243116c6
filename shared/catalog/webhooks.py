"""Webhooks, and the outbox of what is to be told to them.

An event is written in the transaction that makes it true (`announce`), as one delivery for each
webhook that wants it. So none is lost, and nothing is told that did not happen; the steward sends
it afterwards, until it was taken or has failed for good.
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

from shared.catalog.base import Base, JsonValue, UtcDateTime, db_now, partial_index
from shared.errors import NotFound
from shared.ids import new_id

SECRET_PREFIX = "whsec_"  # noqa: S105  (the Standard Webhooks form of a secret)
SECRET_BYTES = 32


class EventKind(StrEnum):
    JOB_SUCCEEDED = "job.succeeded"
    JOB_FAILED = "job.failed"
    BATCH_FINISHED = "batch.finished"  # beside the batch's own job.succeeded or job.failed
    GENERATION_SWITCHED = "generation.switched"


class DeliveryState(StrEnum):
    PENDING = "pending"  # to be tried, or tried again, at `next_attempt_at`
    DELIVERED = "delivered"  # answered with 2xx
    FAILED = "failed"  # given up


class Webhook(Base):
    """Where events are sent. The secret signs them: it has to be kept as it is."""

    __tablename__ = "webhooks"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    url: Mapped[str] = mapped_column(Text)
    events: Mapped[list[str]] = mapped_column(JsonValue)
    secret: Mapped[str] = mapped_column(Text)
    created_at: Mapped[datetime] = mapped_column(UtcDateTime, default=db_now())


class Delivery(Base):
    """One event for one webhook.

    No foreign key: an event is written beside the work of extractors, whom a webhook that is being
    deleted must not stop. What is left of it is never sent.
    """

    __tablename__ = "webhook_deliveries"

    id: Mapped[UUID] = mapped_column(Uuid, primary_key=True, default=new_id)
    webhook_id: Mapped[UUID] = mapped_column(Uuid)
    event_id: Mapped[UUID] = mapped_column(Uuid)  # the same in every try, and for every webhook
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
    """A webhook with a new secret; `shared.security.webhook_targets` says which `url` may be
    one."""
    secret = SECRET_PREFIX + base64.b64encode(secrets.token_bytes(SECRET_BYTES)).decode()
    made = Webhook(url=url, events=sorted(set(events)), secret=secret)
    session.add(made)
    session.flush()
    session.refresh(made)
    return made


def get_webhook(session: Session, webhook_id: UUID) -> Webhook:
    """NotFound (`webhook_not_found`) when there is none."""
    found = session.get(Webhook, webhook_id)
    if found is None:
        raise NotFound("webhook_not_found", f"There is no webhook {webhook_id}.")
    return found


def list_webhooks(session: Session) -> list[Webhook]:
    """Newest first."""
    return list(session.scalars(select(Webhook).order_by(Webhook.id.desc())))


def delete_webhook(session: Session, webhook_id: UUID) -> Webhook:
    """With all of its deliveries, also those that wait."""
    found = get_webhook(session, webhook_id)
    session.execute(delete(Delivery).where(Delivery.webhook_id == webhook_id))
    session.delete(found)
    return found


def list_deliveries(
    session: Session, webhook_id: UUID, limit: int, before: UUID | None
) -> list[Delivery]:
    """What was and will be sent, newest first, up to `limit`, older than `before`."""
    subscribed_webhook_ids = select(Delivery).where(Delivery.webhook_id == webhook_id)
    if before is not None:
        subscribed_webhook_ids = subscribed_webhook_ids.where(Delivery.id < before)
    return list(session.scalars(subscribed_webhook_ids.order_by(Delivery.id.desc()).limit(limit)))


def subscribed_webhook_ids(session: Session, event: EventKind) -> list[UUID]:
    """The webhooks that want the event; they are looked up once in a transaction."""
    webhooks = session.info.get("webhooks")
    if webhooks is None:
        # In the midst of others' changes, which are not to be written before they are whole.
        with session.no_autoflush:
            webhooks = session.execute(select(Webhook.id, Webhook.events)).all()
        session.info["webhooks"] = webhooks
    return [webhook_id for webhook_id, events in webhooks if event in events]


def enqueue_event(session: Session, event: EventKind, data: dict[str, Any]) -> None:
    """Let every webhook that wants it hear of the event once this transaction is committed."""
    webhooks = subscribed_webhook_ids(session, event)
    if not webhooks:
        return
    event_id = new_id()
    said = {"type": event, "timestamp": datetime.now(UTC).isoformat(), "data": data}
    body = json.dumps(said, separators=(",", ":"))
    session.add_all(
        Delivery(webhook_id=webhook_id, event_id=event_id, event=event, body=body)
        for webhook_id in webhooks
    )
