"""Connection limits of an HTTP server: the number of connections, and timeouts for slow clients.

uvicorn has no such limits, and without them a few slow clients can use up all file descriptors
(Slowloris). `LimitedProtocol` adds them to uvicorn's HTTP/1.1 protocol, and `receive_in_time` to
the bodies that an application reads:

| | limit | when exceeded |
|---|---|---|
| connections in total | MAX_CONNECTIONS | the longest idle one is closed; 503 if none is idle |
| connections per address | MAX_CONNECTIONS_PER_ADDRESS | the same, with 429 |
| request head | HEAD_SECONDS | closed |
| request body | BODY_BYTES_PER_SECOND | 408 |
| client does not read the response | STALLED_SECONDS | closed |
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import logging
import resource
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from http import HTTPStatus
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import Any, Self

import h11
from starlette.types import Message, Receive
from uvicorn.protocols.http.h11_impl import H11Protocol

from shared.config.settings import Settings
from shared.errors import PlacewiseError, RequestTimeout, TooManyRequests, Unavailable

log = logging.getLogger(__name__)

HEAD_SECONDS = 20.0
BODY_BYTES_PER_SECOND = 1000
BODY_WINDOW_SECONDS = 10.0
"""Of waiting for a body, over which its rate is measured, and so the longest pause of a client"""
STALLED_SECONDS = 75.0  # within which a client must read a part of its response
RETRY_SECONDS = 1
MAX_OPEN_FILES = 65_536  # file limit that is requested from the system, at most
RESERVED_FILES = 256  # for the catalog, chunks, uploads and other services of the process


class Reason(StrEnum):
    """Why the server closed or refused a connection; values of a metric label."""

    TOTAL_LIMIT = "total_limit"
    ADDRESS_LIMIT = "address_limit"
    SLOW_HEAD = "slow_head"
    SLOW_BODY = "slow_body"
    SLOW_READER = "slow_reader"
    ACCEPT_ERROR = "accept_error"


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """Limits of one server. 0 disables `per_address` and `body_bytes_per_second`."""

    total: int
    per_address: int
    head_seconds: float = HEAD_SECONDS
    body_bytes_per_second: int = BODY_BYTES_PER_SECOND
    body_window_seconds: float = BODY_WINDOW_SECONDS
    stalled_seconds: float = STALLED_SECONDS
    trusted_proxies: tuple[IPv4Network | IPv6Network, ...] = ()
    """Networks whose connections are not limited per address."""

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """Create the limits from the settings, capped by the file limit of the process."""
        files = _raise_file_limit()
        total = min(settings.max_connections, files - min(RESERVED_FILES, files // 2))
        if total < settings.max_connections:
            log.warning(
                "The server accepts %d connections instead of %d (MAX_CONNECTIONS), because this "
                "process may open only %d files. Raise its file limit (ulimit -Hn).",
                total,
                settings.max_connections,
                files,
            )
        return cls(
            total,
            settings.max_connections_per_address,
            trusted_proxies=tuple(map(ip_network, settings.proxy_addresses)),
        )

    def of_address(self, address: str) -> int:
        """Return the maximum number of connections of an address; 0 if it is unlimited."""
        return 0 if is_in_networks(address, self.trusted_proxies) else self.per_address


class Connections:
    """The open connections of a server, and the counts of closed ones.

    Must be used on the event loop of the server; the counts may be read from any thread.
    """

    def __init__(self, limits: ConnectionLimits) -> None:
        self.limits = limits
        self.closed = Counter(dict.fromkeys(Reason, 0))
        self._open: dict[LimitedProtocol, None] = {}
        self._count_by_group: Counter[str] = Counter()
        self._idle: dict[LimitedProtocol, None] = {}
        """Connections without a request in flight; longest idle first."""

    @property
    def count(self) -> int:
        """Number of open connections."""
        return len(self._open)

    def add(self, connection: LimitedProtocol) -> PlacewiseError | None:
        """Add a new connection; close an idle one if a limit is reached.

        Returns:
            The error to respond with if no connection is idle; else None.
        """
        group, limits = connection.group, self.limits
        group_limit = limits.of_address(connection.address)
        if group_limit and self._count_by_group[group] >= group_limit:
            of_group = (idle for idle in self._idle if idle.group == group)
            if not self._close_first(of_group, Reason.ADDRESS_LIMIT):
                return TooManyRequests(
                    "too_many_connections",
                    f"Your address has {group_limit} connections with requests in flight "
                    "(MAX_CONNECTIONS_PER_ADDRESS). Try again when one of them has ended.",
                    retry_after_seconds=RETRY_SECONDS,
                )
        if self.count >= limits.total and not self._close_first(
            iter(self._idle), Reason.TOTAL_LIMIT
        ):
            return Unavailable(
                "too_many_connections",
                f"The server has {limits.total} connections with requests in flight "
                "(MAX_CONNECTIONS). Try again in a moment.",
                retry_after_seconds=RETRY_SECONDS,
            )
        self._open[connection] = None
        self._count_by_group[group] += 1
        self.mark(connection, idle=True)
        return None

    def remove(self, connection: LimitedProtocol) -> None:
        """Remove a connection that is closed or about to be closed. Idempotent."""
        if connection not in self._open:
            return
        del self._open[connection]
        self.mark(connection, idle=False)
        self._count_by_group[connection.group] -= 1
        if not self._count_by_group[connection.group]:
            del self._count_by_group[connection.group]

    def mark(self, connection: LimitedProtocol, *, idle: bool) -> None:
        """Note whether a connection has no request in flight: then it may be closed for another."""
        if idle and connection in self._open:
            self._idle.setdefault(connection)
        else:
            self._idle.pop(connection, None)

    def check(self) -> None:
        """Close connections of slow clients; called about once a second."""
        now = time.monotonic()
        for connection in list(self._open):
            connection.check(now)

    def on_loop_error(self, loop: Any, context: dict[str, Any]) -> None:
        """Exception handler of the event loop that counts failed accepts.

        asyncio pauses after an accept that failed for lack of resources, but would log a traceback
        for each.
        """
        error = context.get("exception")
        if isinstance(error, OSError) and error.errno in (
            errno.EMFILE,
            errno.ENFILE,
            errno.ENOBUFS,
            errno.ENOMEM,
        ):
            self.closed[Reason.ACCEPT_ERROR] += 1
        else:
            loop.default_exception_handler(context)

    def _close_first(self, idle: Iterator[LimitedProtocol], reason: Reason) -> bool:
        """Close the first of these connections; False if there is none."""
        self.closed[reason] += 1
        connection = next(idle, None)
        if connection is None:
            return False
        connection.close()
        return True


class LimitedProtocol(H11Protocol):
    """uvicorn's HTTP/1.1 protocol of one connection, with the limits of `connections`."""

    def __init__(self, connections: Connections, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.address = self.group = ""
        self._connections = connections
        self._head_since: float | None = None
        """When the server began to wait for a request head; None while it does not wait."""
        self._unsent_bytes = 0
        self._unsent_since = 0.0

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.address = self.client[0] if self.client else ""
        self.group = address_group(self.address)
        self._head_since = time.monotonic()
        refusal = self._connections.add(self)
        if refusal is not None:
            self._refuse(refusal)

    def connection_lost(self, exc: Exception | None) -> None:
        self._connections.remove(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._note_state()
        if self.conn.their_state is h11.IDLE and self._head_since is None:
            self._head_since = time.monotonic()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._note_state()

    def resume_writing(self) -> None:
        super().resume_writing()
        self._unsent_since = time.monotonic()

    def _note_state(self) -> None:
        waits_for_head = self.conn.their_state is h11.IDLE
        if not waits_for_head:
            self._head_since = None
        # The rest of a body that the response did not need may never come.
        is_answered = self.cycle is not None and self.cycle.response_complete
        self._connections.mark(self, idle=waits_for_head or is_answered)

    def check(self, now: float) -> None:
        """Close the connection if its client is too slow."""
        limits = self._connections.limits
        unsent = self.transport.get_write_buffer_size()
        if unsent == 0 or unsent < self._unsent_bytes:
            self._unsent_since = now
        self._unsent_bytes = unsent
        if unsent and now - self._unsent_since > limits.stalled_seconds:
            self._connections.closed[Reason.SLOW_READER] += 1
            self.close()
        elif self._head_since is not None and now - self._head_since > limits.head_seconds:
            self._connections.closed[Reason.SLOW_HEAD] += 1
            self.close()

    def close(self) -> None:
        """Abort the connection at once."""
        self._connections.remove(self)
        self.transport.abort()

    def _refuse(self, error: PlacewiseError) -> None:
        """Send the problem to a client that has sent nothing yet, and close the connection."""
        self._head_since = None
        body = json.dumps(error.as_problem()).encode()
        headers = {
            "Content-Type": "application/problem+json",
            "Content-Length": str(len(body)),
            "Connection": "close",
            "Retry-After": str(RETRY_SECONDS),
        }
        head = h11.Response(
            status_code=error.status,
            reason=HTTPStatus(error.status).phrase,
            headers=list(headers.items()),
        )
        for event in (head, h11.Data(data=body), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()


def receive_in_time(receive: Receive, connections: Connections) -> Receive:
    """Return a `receive` that raises RequestTimeout (`request_too_slow`) for slow bodies.

    Only the time counts in which the application waits for the client.
    """
    limits = connections.limits
    waited, received_bytes, complete = 0.0, 0, not limits.body_bytes_per_second

    async def limited() -> Message:
        nonlocal waited, received_bytes, complete
        message: Message | None = None
        while not complete and message is None:
            begun = time.monotonic()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(limits.body_window_seconds):
                    message = await receive()
                received_bytes += len(message.get("body", b""))
                complete = not message.get("more_body")
            waited += time.monotonic() - begun
            if waited < limits.body_window_seconds or complete:
                continue
            if received_bytes < limits.body_bytes_per_second * waited:
                connections.closed[Reason.SLOW_BODY] += 1
                raise RequestTimeout(
                    "request_too_slow",
                    f"The body was received at {received_bytes / waited:.0f} bytes per second; at "
                    f"least {limits.body_bytes_per_second} are required. Send the request again.",
                )
            waited, received_bytes = 0.0, 0
        return message or await receive()

    return limited


def address_group(address: str) -> str:
    """Return the key that limits count as one address: the IPv4 address, or the IPv6 /64 network.

    One customer or machine usually has a whole /64.
    """
    parsed = _parse_address(address)
    if isinstance(parsed, IPv6Address):
        return str(ip_network((int(parsed), 64), strict=False))
    return str(parsed or address)  # a proxy may have set a name


def is_in_networks(address: str, networks: Iterable[IPv4Network | IPv6Network]) -> bool:
    """Return whether the address is an IP address in one of the networks."""
    parsed = _parse_address(address)
    return parsed is not None and any(parsed in network for network in networks)


def _parse_address(address: str) -> IPv4Address | IPv6Address | None:
    try:
        parsed = ip_address(address.partition("%")[0])
    except ValueError:
        return None
    # A server that listens on :: sees 10.0.0.5 as ::ffff:10.0.0.5.
    mapped = parsed.ipv4_mapped if isinstance(parsed, IPv6Address) else None
    return mapped or parsed


def _raise_file_limit() -> int:
    """Raise the soft limit of open files to the hard limit, at most MAX_OPEN_FILES; return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    target = MAX_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_OPEN_FILES)
    if soft == resource.RLIM_INFINITY or soft >= target:
        return MAX_OPEN_FILES if soft == resource.RLIM_INFINITY else soft
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (target, hard))
    except (OSError, ValueError):  # macOS refuses values below its reported hard limit
        return soft
    return target
