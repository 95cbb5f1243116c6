"""One POST to a webhook: to the address that was checked, no further, and not for long."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
import time
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException

from services.steward.webhooks.sign import signed_headers
from shared.catalog.webhooks import Delivery, Webhook
from shared.errors import PlacewiseError
from shared.webhook_address import Target, parse_target, resolve

CONNECT_SECONDS = 5.0
WHOLE_SECONDS = 15.0  # of one try: a receiver that drips its answer is not waited for
USER_AGENT = "Placewise-Webhooks/1"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a try."""

    status: int | None
    """HTTP status; None where there was no answer."""
    error: str | None
    """Why it was no success; None for 2xx."""
    forbidden: bool = False
    """The address may not be called: another try would find the same."""


def send(webhook: Webhook, delivery: Delivery, *, allow_private: bool) -> Outcome:
    """Try it once. Never raises for what the network or the receiver does."""
    try:
        target = parse_target(webhook.url, allow_private=allow_private)
        address = resolve(target, allow_private=allow_private)
    except PlacewiseError as error:
        return Outcome(None, error.detail, forbidden=error.code != "webhook_name_unknown")
    headers = {
        **signed_headers(
            webhook.secret, f"msg_{delivery.event_id}", int(time.time()), delivery.body
        ),
        "Content-Type": "application/json",
        "Host": target.host_header,
        "User-Agent": USER_AGENT,
        "Connection": "close",
    }
    try:
        status = _post(target, address, headers, delivery.body.encode())
    except (OSError, HTTPException, ValueError) as error:
        return Outcome(None, f"{type(error).__name__}: {error}"[:500])
    if 200 <= status < 300:
        return Outcome(status, None)
    if 300 <= status < 400:
        return Outcome(status, f"answered HTTP {status}: redirects are not followed")
    return Outcome(status, f"answered HTTP {status}")


def _post(target: Target, address: str, headers: dict[str, str], body: bytes) -> int:
    """The answer's status. Its body is not read: nothing that it says is of use."""
    deadline = time.monotonic() + WHOLE_SECONDS
    connection = HTTPConnection(target.host, target.port, timeout=WHOLE_SECONDS)
    with contextlib.closing(connection):
        connected = socket.create_connection((address, target.port), CONNECT_SECONDS)
        connection.sock = connected
        # Each read has a time limit of its own; this one is for all of them together.
        end = threading.Timer(deadline - time.monotonic(), _cut, [connected])
        end.daemon = True
        end.start()
        try:
            connected.settimeout(max(0.1, deadline - time.monotonic()))
            if target.scheme == "https":
                # The certificate has to be the name's, though the connection went to an address.
                connection.sock = ssl.create_default_context().wrap_socket(
                    connected, server_hostname=target.host
                )
            connection.request("POST", target.path, body=body, headers=headers)
            return connection.getresponse().status
        finally:
            end.cancel()


def _cut(connected: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connected.shutdown(socket.SHUT_RDWR)
