"""The outbox's other end: what is due is sent, tried again later, or given up.

A try is claimed in one transaction and its end is written in another. Whoever dies between them
leaves a delivery that comes due again: each is sent at least once, and its id tells the receiver
which he has had already.
"""

from __future__ import annotations

import logging
import random
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import UUID

from sqlalchemy import select, update
from sqlalchemy.exc import SQLAlchemyError

from services.steward.webhooks.send import WHOLE_SECONDS, Outcome, send
from shared.catalog.away import Outage
from shared.catalog.base import db_now, db_now_plus
from shared.catalog.session import Catalog
from shared.catalog.webhooks import Delivery, DeliveryState, Webhook
from shared.settings import Settings

log = logging.getLogger(__name__)

LOOK_SECONDS = 1.0
AT_ONCE = 8  # tries at a time: one slow receiver must not keep the others waiting
CLAIM_SECONDS = 4 * WHOLE_SECONDS  # after which a try whose steward died is due again
# Between tries, as the Standard Webhooks specification recommends: 10 tries within some three days.
PAUSES_SECONDS = (5, 300, 1800, 7200, 18_000, 36_000, 50_400, 72_000, 86_400)
SPREAD = 0.2  # of a pause, at random: receivers that come back are not met by everyone at once


class WebhookSender:
    """Sends what is due; `run` until stopped. Any number of stewards may have one."""

    def __init__(self, catalog: Catalog, settings: Settings) -> None:
        self._catalog = catalog
        self._allow_private = settings.webhook_private_addresses
        self._outage = Outage("sender of webhooks")

    def run(self, stop: threading.Event) -> None:
        """Send until `stop` is set."""
        with ThreadPoolExecutor(AT_ONCE, thread_name_prefix="webhook") as pool:
            while not stop.is_set():
                try:
                    sent = self.send_due(pool)
                    self._outage.over()
                except SQLAlchemyError as error:
                    sent = 0
                    self._outage.met(error)
                if sent < AT_ONCE:
                    stop.wait(LOOK_SECONDS)

    def send_due(self, pool: ThreadPoolExecutor) -> int:
        """Try what is due, AT_ONCE at most; how many that were."""
        claimed = self._claim()
        for _ in pool.map(self._try, claimed):
            pass
        return len(claimed)

    def _claim(self) -> list[Delivery]:
        is_due = (
            Delivery.state == DeliveryState.PENDING,
            Delivery.next_attempt_at <= db_now(),
        )
        with self._catalog.read() as session:
            # SQLite has one writer: it is not troubled each second for nothing.
            if session.scalar(select(Delivery.id).where(*is_due).limit(1)) is None:
                return []
        due = (
            select(Delivery)
            .where(*is_due)
            .order_by(Delivery.next_attempt_at)
            .limit(AT_ONCE)
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
            return claimed

    def _try(self, delivery: Delivery) -> None:
        with self._catalog.read() as session:
            webhook = session.get(Webhook, delivery.webhook_id)
        if webhook is None:  # deleted while the event was being written
            outcome = Outcome(None, "the webhook was deleted", forbidden=True)
        else:
            outcome = send(webhook, delivery, allow_private=self._allow_private)
        self._note(delivery.id, delivery.attempts, outcome)

    def _note(self, delivery_id: UUID, attempts: int, outcome: Outcome) -> None:
        values: dict[str, Any] = {"last_status": outcome.status, "last_error": outcome.error}
        pause = pause_seconds(attempts)
        if outcome.error is None:
            values |= {"state": DeliveryState.DELIVERED, "ended_at": db_now()}
        elif outcome.forbidden or pause is None:
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


def pause_seconds(attempts: int) -> float | None:
    """Until the next try, after so many; None when it is given up."""
    if attempts > len(PAUSES_SECONDS):
        return None
    return PAUSES_SECONDS[attempts - 1] * random.uniform(1, 1 + SPREAD)  # noqa: S311
