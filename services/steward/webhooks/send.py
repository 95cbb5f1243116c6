"""One POST to a webhook: to the address that was checked, no further, and not for long."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, TypeVar

import httpcore2

from services.steward.webhooks.sign import signature_headers
from shared.catalog.webhooks import Delivery, Webhook
from shared.errors import PlacewiseError
from shared.webhook_address import parse_webhook_url, resolve_webhook_target

# Deadline of one attempt: name lookup, connection, TLS handshake, request and response head.
ATTEMPT_SECONDS = 15.0
USER_AGENT = "Placewise-Webhooks/1"
HTTP_ERRORS = (httpcore2.NetworkError, httpcore2.ProtocolError, httpcore2.TimeoutException)

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class DeliveryAttempt:
    """What came of a try."""

    status: int | None
    """HTTP status; None where there was no answer."""
    error: str | None
    """Why it was no success; None for 2xx."""
    is_permanent: bool = False
    """The address may not be called: another try would find the same."""


class PinnedBackend(httpcore2.AnyIOBackend):
    """Connects to one address, whichever host is named; TLS still verifies the host name."""

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


async def send_webhook(
    webhook: Webhook, delivery: Delivery, tls: ssl.SSLContext, *, allow_private: bool
) -> DeliveryAttempt:
    """Attempt the delivery once, for ATTEMPT_SECONDS at most.

    Never raises for what the network or the receiver does. `tls` verifies the receiver's
    certificate. Redirects are not followed, and proxies of the environment are not used.
    """
    try:
        async with asyncio.timeout(ATTEMPT_SECONDS):
            status = await _post(webhook, delivery, tls, allow_private)
    except PlacewiseError as error:
        return DeliveryAttempt(
            None, error.detail, is_permanent=error.code != "webhook_name_unknown"
        )
    except TimeoutError:
        return DeliveryAttempt(None, f"no answer within {ATTEMPT_SECONDS:g} seconds")
    except (OSError, ValueError, *HTTP_ERRORS) as error:
        return DeliveryAttempt(None, f"{type(error).__name__}: {error}"[:500])
    if 200 <= status < 300:
        return DeliveryAttempt(status, None)
    if 300 <= status < 400:
        return DeliveryAttempt(status, f"answered HTTP {status}: redirects are not followed")
    return DeliveryAttempt(status, f"answered HTTP {status}")


async def _post(
    webhook: Webhook, delivery: Delivery, tls: ssl.SSLContext, allow_private: bool
) -> int:
    """The response's status. Its body is not read: nothing in it is of use."""
    target = parse_webhook_url(webhook.url, allow_private=allow_private)
    address = await in_daemon_thread(
        lambda: resolve_webhook_target(target, allow_private=allow_private)
    )
    signed = signature_headers(
        webhook.secret, f"msg_{delivery.event_id}", int(time.time()), delivery.body
    )
    headers = [
        *signed.items(),
        ("Content-Type", "application/json"),
        ("Host", target.host_header),
        ("User-Agent", USER_AGENT),
        ("Connection", "close"),
    ]
    url = httpcore2.URL(
        scheme=target.scheme, host=target.host, port=target.port, target=target.path
    )
    backend = PinnedBackend(address)
    async with (
        contextlib.aclosing(backend),
        httpcore2.AsyncConnectionPool(ssl_context=tls, network_backend=backend) as pool,
        pool.stream("POST", url, headers=headers, content=delivery.body.encode()) as response,
    ):
        return response.status


def in_daemon_thread(call: Callable[[], T]) -> asyncio.Future[T]:
    """Run a blocking call that cannot be interrupted, such as a name lookup.

    Returns:
        Its result. Whoever gives up waiting for it leaves it behind: no event loop and no exiting
        process waits for a daemon thread, as they do for the threads of an executor.
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
