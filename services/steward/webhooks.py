"""Delivers signed webhook events from the outbox (`shared.catalog.webhooks`), with retries.

Events are signed by the Standard Webhooks specification 1.0. A request goes only to the IP address
that was checked, without redirects, and has a deadline.

Delivery is at least once: an attempt is claimed in one transaction and its result is written in
another, so a delivery whose steward died in between becomes due again. The receiver recognises a
duplicate by the event's id.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import hmac
import logging
import random
import ssl
import threading
import time
from collections.abc import Callable, Collection
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, TypeVar
from uuid import UUID

import httpcore2
from sqlalchemy import ColumnElement, exists, select, update
from sqlalchemy.exc import SQLAlchemyError

from shared.catalog.database.base import db_now, db_now_plus
from shared.catalog.database.errors import OutageLog
from shared.catalog.database.session import Catalog, ChangePoll
from shared.catalog.webhooks import SECRET_PREFIX, Delivery, DeliveryState, Webhook
from shared.config.settings import Settings
from shared.errors import PlacewiseError
from shared.security.webhook_targets import parse_webhook_url, resolve_webhook_target

log = logging.getLogger(__name__)


def sign_webhook(secret: str, message_id: str, timestamp_seconds: int, body: str) -> str:
    """Return the signature: `v1,` and the base64 of HMAC-SHA256 over `id.timestamp.body`.

    The secret is `whsec_` and the key in base64. By the time, a receiver can reject old messages.
    """
    key = base64.b64decode(secret.removeprefix(SECRET_PREFIX))
    signed = f"{message_id}.{timestamp_seconds}.{body}".encode()
    return "v1," + base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()


# Deadline of one attempt: name lookup, connection, TLS handshake, request and response head.
ATTEMPT_SECONDS = 15.0
USER_AGENT = "Placewise-Webhooks/1"
HTTP_ERRORS = (httpcore2.NetworkError, httpcore2.ProtocolError, httpcore2.TimeoutException)

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class _DeliveryAttempt:
    status: int | None
    """HTTP status; None without a response."""
    error: str | None
    """Why it failed; None for a 2xx response."""
    is_permanent: bool = False
    """The address is not allowed: a retry would fail, too."""


class _PinnedBackend(httpcore2.AnyIOBackend):
    """Connects to one IP address, whatever the host name; TLS still verifies the host name."""

    def __init__(self, address: str) -> None:
        super().__init__()
        self._address = address
        self._stream: httpcore2.AsyncNetworkStream | None = None

    async def connect_tcp(
        self, host: str, port: int, *args: Any, **options: Any
    ) -> httpcore2.AsyncNetworkStream:
        self._stream = await super().connect_tcp(self._address, port, *args, **options)
        return self._stream

    async def aclose(self) -> None:
        """Close the connection: the pool forgets one that was cancelled in its TLS handshake."""
        if self._stream is not None:
            await self._stream.aclose()


async def _send_webhook(
    webhook: Webhook, delivery: Delivery, tls: ssl.SSLContext, *, allow_private: bool
) -> _DeliveryAttempt:
    """Send the delivery once, within ATTEMPT_SECONDS.

    Redirects are not followed, and the proxies of the environment are not used. Network errors and
    error responses are returned, not raised. `allow_private` allows private IP addresses.
    """
    try:
        async with asyncio.timeout(ATTEMPT_SECONDS):
            status = await _post(webhook, delivery, tls, allow_private)
    except PlacewiseError as error:
        return _DeliveryAttempt(
            None, error.detail, is_permanent=error.code != "webhook_name_unknown"
        )
    except TimeoutError:
        return _DeliveryAttempt(None, f"no answer within {ATTEMPT_SECONDS:g} seconds")
    except (OSError, ValueError, *HTTP_ERRORS) as error:
        return _DeliveryAttempt(None, f"{type(error).__name__}: {error}"[:500])
    if 200 <= status < 300:
        return _DeliveryAttempt(status, None)
    if 300 <= status < 400:
        return _DeliveryAttempt(status, f"answered HTTP {status}: redirects are not followed")
    return _DeliveryAttempt(status, f"answered HTTP {status}")


async def _post(
    webhook: Webhook, delivery: Delivery, tls: ssl.SSLContext, allow_private: bool
) -> int:
    """Send the request and return the response's status; its body is not read."""
    target = parse_webhook_url(webhook.url, allow_private=allow_private)
    address = await _in_daemon_thread(
        lambda: resolve_webhook_target(target, allow_private=allow_private)
    )
    message_id, timestamp = f"msg_{delivery.event_id}", int(time.time())  # an id for all attempts
    headers = [
        ("webhook-id", message_id),
        ("webhook-timestamp", str(timestamp)),
        ("webhook-signature", sign_webhook(webhook.secret, message_id, timestamp, delivery.body)),
        ("Content-Type", "application/json"),
        ("Host", target.host_header),
        ("User-Agent", USER_AGENT),
        ("Connection", "close"),
    ]
    url = httpcore2.URL(
        scheme=target.scheme, host=target.host, port=target.port, target=target.path
    )
    backend = _PinnedBackend(address)
    async with (
        contextlib.aclosing(backend),
        httpcore2.AsyncConnectionPool(ssl_context=tls, network_backend=backend) as pool,
        pool.stream("POST", url, headers=headers, content=delivery.body.encode()) as response,
    ):
        return response.status


def _in_daemon_thread(call: Callable[[], T]) -> asyncio.Future[T]:
    """Run a blocking call that cannot be interrupted, such as a name lookup.

    Unlike the threads of an executor, a daemon thread delays neither the end of the event loop nor
    the exit of the process when its result is no longer awaited.
    """
    result: Future[T] = Future()
    result.set_running_or_notify_cancel()

    def run() -> None:
        try:
            result.set_result(call())
        except BaseException as error:
            result.set_exception(error)

    threading.Thread(target=run, name="webhook", daemon=True).start()
    return asyncio.wrap_future(result)


DELIVERY_POLL_SECONDS = 1.0
MAX_WEBHOOKS = 32  # served at the same time
MAX_IN_FLIGHT = 4  # attempts at the same time for one webhook
CLAIM_SECONDS = 4 * ATTEMPT_SECONDS  # after which an attempt whose steward died is due again
# Delays between attempts, as the Standard Webhooks specification recommends: 10 attempts in about
# three days.
RETRY_DELAYS_SECONDS = (5, 300, 1800, 7200, 18_000, 36_000, 50_400, 72_000, 86_400)
RETRY_JITTER = 0.2  # largest random share added to a delay, to spread the retries


class WebhookDispatcher:
    """Sends due deliveries. Any number of stewards may run one.

    Each webhook with due deliveries has a task of its own, so a receiver that hangs delays only
    its own deliveries, and at most MAX_IN_FLIGHT of them are in flight.
    """

    def __init__(self, catalog: Catalog, settings: Settings) -> None:
        self._catalog = catalog
        self._allow_private = settings.webhook_private_addresses
        self._tls = ssl.create_default_context()
        self._outage = OutageLog("webhook dispatcher")

    def run(self, stop: threading.Event) -> None:
        """Send deliveries until `stop` is set.

        Attempts in flight are then cancelled; they become due again after CLAIM_SECONDS.
        """
        asyncio.run(self._run(stop))  # cancels the remaining tasks

    async def _run(self, stop: threading.Event) -> None:
        stopped = _in_daemon_thread(stop.wait)
        tasks: dict[UUID, asyncio.Task[None]] = {}
        poll = ChangePoll(self._catalog)
        has_pending = True
        while not stopped.done():
            due: list[UUID] = []
            try:
                if poll.is_due() or tasks or has_pending:
                    due = await asyncio.to_thread(self.due_webhooks, list(tasks))
                    has_pending = bool(due) or await asyncio.to_thread(self._has_pending)
                    if not due:
                        self._outage.record_success()
            except SQLAlchemyError as error:
                self._outage.record_error(error)
            # At random, so that webhooks with a backlog don't starve the others.
            for webhook_id in random.sample(due, min(len(due), MAX_WEBHOOKS - len(tasks))):
                tasks[webhook_id] = asyncio.create_task(self._serve(webhook_id))
            awaited: set[asyncio.Future[Any]] = {stopped, *tasks.values()}
            await asyncio.wait(
                awaited, timeout=DELIVERY_POLL_SECONDS, return_when=asyncio.FIRST_COMPLETED
            )
            for webhook_id in [id_ for id_, task in tasks.items() if task.done()]:
                tasks.pop(webhook_id).result()  # raises unexpected errors

    async def _serve(self, webhook_id: UUID) -> None:
        try:
            await self.deliver_due(webhook_id)
            self._outage.record_success()
        except SQLAlchemyError as error:
            self._outage.record_error(error)
            await asyncio.sleep(DELIVERY_POLL_SECONDS)

    def due_webhooks(self, excluded: Collection[UUID] = ()) -> list[UUID]:
        """Return the ids of webhooks with due deliveries, except those in `excluded`."""
        due = select(Delivery.webhook_id).where(*_is_due(), Delivery.webhook_id.not_in(excluded))
        with self._catalog.read() as session:
            return list(session.scalars(due.distinct()))

    def _has_pending(self) -> bool:
        pending = exists().where(Delivery.state == DeliveryState.PENDING)
        with self._catalog.read() as session:
            return bool(session.scalar(select(pending)))

    async def deliver_due(self, webhook_id: UUID) -> int:
        """Attempt the due deliveries of one webhook, up to MAX_IN_FLIGHT; return their number."""
        webhook, claimed = await asyncio.to_thread(self._claim_due, webhook_id)
        results = await asyncio.gather(
            *(self._attempt(webhook, delivery) for delivery in claimed), return_exceptions=True
        )
        for error in results:  # after all have ended: an error must not cancel the others
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
            live = select(Webhook).where(Webhook.id == webhook_id, Webhook.deleted_at.is_(None))
            return session.scalar(live), claimed

    async def _attempt(self, webhook: Webhook | None, delivery: Delivery) -> None:
        if webhook is None:  # deleted while the event was being written
            outcome = _DeliveryAttempt(None, "the webhook was deleted", is_permanent=True)
        else:
            outcome = await _send_webhook(
                webhook, delivery, self._tls, allow_private=self._allow_private
            )
        await asyncio.to_thread(self._record_attempt, delivery.id, delivery.attempts, outcome)

    def _record_attempt(self, delivery_id: UUID, attempts: int, outcome: _DeliveryAttempt) -> None:
        values: dict[str, Any] = {"last_status": outcome.status, "last_error": outcome.error}
        delay = retry_delay_seconds(attempts)
        if outcome.error is None:
            values |= {"state": DeliveryState.DELIVERED, "ended_at": db_now()}
        elif outcome.is_permanent or delay is None:
            values |= {"state": DeliveryState.FAILED, "ended_at": db_now()}
            log.warning("webhook delivery %s failed permanently: %s", delivery_id, outcome.error)
        else:
            values |= {"next_attempt_at": db_now_plus(delay)}
        with self._catalog.write() as session:
            session.execute(
                update(Delivery)
                # Unless another steward has taken it over since.
                .where(Delivery.id == delivery_id, Delivery.attempts == attempts)
                .values(**values)
                .execution_options(synchronize_session=False)
            )


def _is_due() -> tuple[ColumnElement[bool], ...]:
    return (Delivery.state == DeliveryState.PENDING, Delivery.next_attempt_at <= db_now())


def retry_delay_seconds(attempts: int) -> float | None:
    """Return the delay before the next attempt, after `attempts` failures; None to give up."""
    if attempts > len(RETRY_DELAYS_SECONDS):
        return None
    return RETRY_DELAYS_SECONDS[attempts - 1] * random.uniform(1, 1 + RETRY_JITTER)  # noqa: S311
