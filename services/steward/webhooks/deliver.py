"""The outbox's other end: what is due is sent, tried again later, or given up.

A try is claimed in one transaction and its end is written in another. Whoever dies between them
leaves a delivery that comes due again: each is sent at least once, and its id tells the receiver
which he has had already.
"""

from __future__ import annotations

import asyncio
import logging
import random
import ssl
import threading
from collections.abc import Collection
from typing import Any
from uuid import UUID

from sqlalchemy import ColumnElement, select, update
from sqlalchemy.exc import SQLAlchemyError

from services.steward.webhooks.send import (
    ATTEMPT_SECONDS,
    DeliveryAttempt,
    in_daemon_thread,
    send_webhook,
)
from shared.catalog.away import OutageLog
from shared.catalog.base import db_now, db_now_plus
from shared.catalog.session import Catalog
from shared.catalog.webhooks import Delivery, DeliveryState, Webhook
from shared.settings import Settings

log = logging.getLogger(__name__)

DELIVERY_POLL_SECONDS = 1.0
MAX_WEBHOOKS = 32  # served at the same time
MAX_IN_FLIGHT = 4  # attempts for one webhook
CLAIM_SECONDS = 4 * ATTEMPT_SECONDS  # after which a try whose steward died is due again
# Between tries, as the Standard Webhooks specification recommends: 10 tries within some three days.
RETRY_DELAYS_SECONDS = (5, 300, 1800, 7200, 18_000, 36_000, 50_400, 72_000, 86_400)
RETRY_JITTER = (
    0.2  # of a pause, at random: receivers that come back are not met by everyone at once
)


class WebhookDispatcher:
    """Sends what is due; `run` until stopped. Any number of stewards may have one.

    Each webhook with due deliveries has a task of its own, so a receiver that hangs delays only
    its own deliveries, and at most MAX_IN_FLIGHT of them are in flight.
    """

    def __init__(self, catalog: Catalog, settings: Settings) -> None:
        self._catalog = catalog
        self._allow_private = settings.webhook_private_addresses
        self._tls = ssl.create_default_context()
        self._outage = OutageLog("sender of webhooks")

    def run(self, stop: threading.Event) -> None:
        """Send until `stop` is set. Attempts in flight are then cut off, not waited for: they
        come due again after CLAIM_SECONDS."""
        asyncio.run(self._run(stop))  # which cancels the tasks that are left

    async def _run(self, stop: threading.Event) -> None:
        stopped = in_daemon_thread(stop.wait)
        tasks: dict[UUID, asyncio.Task[None]] = {}
        while not stopped.done():
            try:
                due = await asyncio.to_thread(self.due_webhooks, list(tasks))
                if not due:
                    self._outage.record_success()
            except SQLAlchemyError as error:
                due = []
                self._outage.record_error(error)
            # At random: webhooks with a backlog must not keep the others from the last places.
            for webhook_id in random.sample(due, min(len(due), MAX_WEBHOOKS - len(tasks))):
                tasks[webhook_id] = asyncio.create_task(self._serve(webhook_id))
            awaited: set[asyncio.Future[Any]] = {stopped, *tasks.values()}
            await asyncio.wait(
                awaited, timeout=DELIVERY_POLL_SECONDS, return_when=asyncio.FIRST_COMPLETED
            )
            for webhook_id in [one for one, task in tasks.items() if task.done()]:
                tasks.pop(webhook_id).result()  # raises what nobody has foreseen

    async def _serve(self, webhook_id: UUID) -> None:
        try:
            await self.deliver_due(webhook_id)
            self._outage.record_success()
        except SQLAlchemyError as error:
            self._outage.record_error(error)
            await asyncio.sleep(DELIVERY_POLL_SECONDS)

    def due_webhooks(self, besides: Collection[UUID] = ()) -> list[UUID]:
        """Ids of webhooks with due deliveries, but for those in `besides`."""
        due = select(Delivery.webhook_id).where(*_is_due(), Delivery.webhook_id.not_in(besides))
        with self._catalog.read() as session:
            return list(session.scalars(due.distinct()))

    async def deliver_due(self, webhook_id: UUID) -> int:
        """Attempt what is due for one webhook, MAX_IN_FLIGHT at most; how many that were."""
        webhook, claimed = await asyncio.to_thread(self._claim_due, webhook_id)
        ends = await asyncio.gather(
            *(self._attempt(webhook, delivery) for delivery in claimed), return_exceptions=True
        )
        for error in ends:  # only now: one that can't be noted must not cut off the others
            if error is not None:
                raise error
        return len(claimed)

    def _claim_due(self, webhook_id: UUID) -> tuple[Webhook | None, list[Delivery]]:
        due = (
            select(Delivery)
            .where(*_is_due(), Delivery.webhook_id == webhook_id)
            .order_by(Delivery.next_attempt_at)
            .limit(MAX_IN_FLIGHT)
            .with_for_update(skip_locked=True)
        )
        with self._catalog.write() as session:
            claimed = list(session.scalars(due))
            for delivery in claimed:
                delivery.attempts += 1
                delivery.next_attempt_at = db_now_plus(CLAIM_SECONDS)
            session.flush()
            for delivery in claimed:
                session.refresh(delivery)
            return session.get(Webhook, webhook_id), claimed

    async def _attempt(self, webhook: Webhook | None, delivery: Delivery) -> None:
        if webhook is None:  # deleted while the event was being written
            outcome = DeliveryAttempt(None, "the webhook was deleted", is_permanent=True)
        else:
            outcome = await send_webhook(
                webhook, delivery, self._tls, allow_private=self._allow_private
            )
        await asyncio.to_thread(self._record_attempt, delivery.id, delivery.attempts, outcome)

    def _record_attempt(self, delivery_id: UUID, attempts: int, outcome: DeliveryAttempt) -> None:
        values: dict[str, Any] = {"last_status": outcome.status, "last_error": outcome.error}
        pause = retry_delay_seconds(attempts)
        if outcome.error is None:
            values |= {"state": DeliveryState.DELIVERED, "ended_at": db_now()}
        elif outcome.is_permanent or pause is None:
            values |= {"state": DeliveryState.FAILED, "ended_at": db_now()}
            log.warning("webhook delivery %s is given up: %s", delivery_id, outcome.error)
        else:
            values |= {"next_attempt_at": db_now_plus(pause)}
        with self._catalog.write() as session:
            session.execute(
                update(Delivery)
                # Not where another steward has taken it over since.
                .where(Delivery.id == delivery_id, Delivery.attempts == attempts)
                .values(**values)
                .execution_options(synchronize_session=False)
            )


def _is_due() -> tuple[ColumnElement[bool], ...]:
    return (Delivery.state == DeliveryState.PENDING, Delivery.next_attempt_at <= db_now())


def retry_delay_seconds(attempts: int) -> float | None:
    """Until the next try, after so many; None when it is given up."""
    if attempts > len(RETRY_DELAYS_SECONDS):
        return None
    return RETRY_DELAYS_SECONDS[attempts - 1] * random.uniform(1, 1 + RETRY_JITTER)  # noqa: S311
