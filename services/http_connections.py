"""Limits for the connections of an HTTP server: how many, and how slow their clients may be.

uvicorn has no such limits. `LimitedProtocol` adds them to its HTTP/1.1 protocol:

| what | limit | beyond it |
|---|---|---|
| connections in all | MAX_CONNECTIONS | an idle one is closed; where none is, 503 |
| connections of one address | MAX_CONNECTIONS_PER_ADDRESS | the same, 429 |
| a request's head | REQUEST_HEAD_SECONDS | 408; closed where nothing came |
| a request's body | MIN_BODY_BYTES_PER_SECOND | 408 |
| an answer that is not read | STALLED_SECONDS | closed |
"""

from __future__ import annotations

import errno
import json
import logging
import resource
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from enum import StrEnum
from http import HTTPStatus
from ipaddress import IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import Any, Self, cast

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from shared.config.settings import Settings
from shared.errors import PlacewiseError, RequestTimeout, TooManyRequests, Unavailable
from shared.http.problem_details import CLOSED_STATUS_SCOPE_KEY

log = logging.getLogger(__name__)

# The body's rate is taken over this time: as long may a client be silent. Time in which the server
# does not read does not count.
BODY_WINDOW_SECONDS = 10.0
STALLED_SECONDS = 75.0  # in which a client has to read something of its answer
RETRY_SECONDS = 1
LOG_SECONDS = 60.0  # between two lines about closed connections
MOST_FILES = 65_536  # more than this is not asked of the system
RESERVED_FILES = 256  # for the catalog, chunks, uploads and other parts of the process


class Reason(StrEnum):
    """Why the server closed a connection or did not take one; values of a metric's label."""

    TOTAL_LIMIT = "total_limit"
    ADDRESS_LIMIT = "address_limit"
    SLOW_HEAD = "slow_head"
    SLOW_BODY = "slow_body"
    SLOW_READER = "slow_reader"
    ACCEPT_ERROR = "accept_error"


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """Limits of one server. `per_address` and `body_bytes_per_second`: 0 for none."""

    total: int
    per_address: int
    head_seconds: float
    body_bytes_per_second: int
    trusted_proxies: tuple[IPv4Network | IPv6Network, ...] = ()
    """Their connections are not limited per address."""

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """The settings' limits, lower where this process may open few files."""
        files = raise_file_limit()
        total = min(settings.max_connections, files - min(RESERVED_FILES, files // 2))
        if total < settings.max_connections:
            log.warning(
                "The server takes %d connections instead of %d (MAX_CONNECTIONS): this process may "
                "open %d files. Raise its limit (ulimit -Hn) for more.",
                total,
                settings.max_connections,
                files,
            )
        return cls(
            total,
            settings.max_connections_per_address,
            settings.request_head_seconds,
            settings.min_body_bytes_per_second,
            tuple(map(ip_network, settings.proxy_addresses)),
        )

    def of_address(self, address: str) -> int:
        """Connections that the address may have; 0 for any number."""
        trusted = address and any(ip_address(address) in net for net in self.trusted_proxies)
        return 0 if trusted else self.per_address


class Connections:
    """The open connections of a server. For its event loop; figures may be read anywhere."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self.limits = limits
        self.closed = Counter(dict.fromkeys(Reason, 0))
        self._open: dict[LimitedProtocol, None] = {}
        self._of_group: Counter[str] = Counter()
        self._idle: defaultdict[str, dict[LimitedProtocol, None]] = defaultdict(dict)
        """Without a request under way, of each group of addresses; longest idle first."""
        self._logged = Counter(self.closed)
        self._next_log = 0.0

    @property
    def count(self) -> int:
        """Connections that are open now."""
        return len(self._open)

    def add(self, connection: LimitedProtocol) -> PlacewiseError | None:
        """Count a new connection, closing an idle one where there are too many; the refusal where
        none is idle."""
        group, limits = connection.group, self.limits
        most = limits.of_address(connection.address)
        if (
            most
            and self._of_group[group] >= most
            and not self._close_idle(group, Reason.ADDRESS_LIMIT)
        ):
            self.closed[Reason.ADDRESS_LIMIT] += 1
            return TooManyRequests(
                "too_many_connections",
                f"Your address has {most} connections with calls under way "
                "(MAX_CONNECTIONS_PER_ADDRESS). Call again when one has ended.",
                retry_after_seconds=RETRY_SECONDS,
            )
        if self.count >= limits.total and not self._close_idle(
            max(self._idle, key=lambda group: len(self._idle[group]), default=group),
            Reason.TOTAL_LIMIT,
        ):
            self.closed[Reason.TOTAL_LIMIT] += 1
            return Unavailable(
                "too_many_connections",
                f"The server has {limits.total} connections with calls under way "
                "(MAX_CONNECTIONS). Call again in a moment.",
                retry_after_seconds=RETRY_SECONDS,
            )
        self._open[connection] = None
        self._of_group[group] += 1
        self.mark_idle(connection)
        return None

    def remove(self, connection: LimitedProtocol) -> None:
        """The connection is closed, or about to be. May be called again."""
        if connection not in self._open:
            return
        del self._open[connection]
        self.mark_busy(connection)
        self._of_group[connection.group] -= 1
        if not self._of_group[connection.group]:
            del self._of_group[connection.group]

    def mark_idle(self, connection: LimitedProtocol) -> None:
        """No request of the connection is under way: it may be closed for another one."""
        if connection in self._open:
            self._idle[connection.group].setdefault(connection)

    def mark_busy(self, connection: LimitedProtocol) -> None:
        idle = self._idle.get(connection.group, {})
        idle.pop(connection, None)
        if not idle:
            self._idle.pop(connection.group, None)

    def check(self) -> None:
        """Close what is too slow, and log what was closed; called about once a second."""
        now = time.monotonic()
        for connection in list(self._open):
            connection.check(now)
        if self.closed != self._logged and now >= self._next_log:
            since = self.closed - self._logged
            self._logged, self._next_log = Counter(self.closed), now + LOG_SECONDS
            log.warning(
                "Connections closed or refused: %s; open now: %d",
                ", ".join(f"{reason} {count}" for reason, count in sorted(since.items())),
                self.count,
            )

    def on_loop_error(self, loop: Any, context: dict[str, Any]) -> None:
        """The event loop's exception handler. asyncio pauses after an accept that failed for lack
        of resources, but logs a trace for each."""
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

    def _close_idle(self, group: str, reason: Reason) -> bool:
        """Close the group's connection that has been idle for longest, if there is one."""
        oldest = next(iter(self._idle.get(group, ())), None)
        if oldest is None:
            return False
        self.closed[reason] += 1
        oldest.close()
        return True


class LimitedProtocol(H11Protocol):
    """uvicorn's protocol of one connection, within the limits of `connections`."""

    def __init__(self, connections: Connections, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.address = self.group = ""
        self._connections = connections
        self._head_since: float | None = None
        """When the server began to wait for the head's rest; None while it does not."""
        self._window_since: float | None = None
        """When the body's window began; None while no body is received."""
        self._window_bytes = 0
        self._paused = False  # reading was, in this window
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
        self._window_bytes += len(data)
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
        state = self.conn.their_state
        if state is h11.IDLE:
            self._connections.mark_idle(self)
        else:
            self._head_since = None
            self._connections.mark_busy(self)
        if state is not h11.SEND_BODY:
            self._window_since = None
        elif self._window_since is None:
            self._begin_window(time.monotonic())
        else:
            self._paused |= self.flow.read_paused

    def check(self, now: float) -> None:
        """Close the connection if its client is too slow."""
        limits = self._connections.limits
        unsent = self.transport.get_write_buffer_size()
        if unsent == 0 or unsent < self._unsent_bytes:
            self._unsent_since = now
        self._unsent_bytes = unsent
        if unsent and now - self._unsent_since > STALLED_SECONDS:
            self._connections.closed[Reason.SLOW_READER] += 1
            self.close()
        elif self._head_since is not None and now - self._head_since > limits.head_seconds:
            self._connections.closed[Reason.SLOW_HEAD] += 1
            if self.conn.trailing_data[0]:
                self._refuse(
                    RequestTimeout(
                        "request_too_slow",
                        "The head of the request did not come within "
                        f"{limits.head_seconds:g} seconds (REQUEST_HEAD_SECONDS).",
                    )
                )
            else:
                self.close()
        elif self._window_since is not None and now - self._window_since >= BODY_WINDOW_SECONDS:
            least = limits.body_bytes_per_second * (now - self._window_since)
            waits_for_us = self._paused or self.cycle.waiting_for_100_continue
            if self._window_bytes < least and not waits_for_us:
                self._connections.closed[Reason.SLOW_BODY] += 1
                self._refuse(
                    RequestTimeout(
                        "request_too_slow",
                        f"The body came with {self._window_bytes / (now - self._window_since):.0f} "
                        f"bytes a second; at least {limits.body_bytes_per_second} are expected "
                        "(MIN_BODY_BYTES_PER_SECOND). Send the request again.",
                    )
                )
            else:
                self._begin_window(now)

    def close(self) -> None:
        """Close the connection at once."""
        self._connections.remove(self)
        self.transport.abort()

    def _begin_window(self, now: float) -> None:
        self._window_since, self._window_bytes = now, 0
        self._paused = self.flow.read_paused

    def _refuse(self, error: PlacewiseError) -> None:
        """Answer with the problem, unless an answer has begun, and close the connection."""
        self._connections.remove(self)
        self._head_since = self._window_since = None
        under_way = self.cycle is not None and not self.cycle.response_complete
        if not (under_way and self.cycle.response_started):
            self.transport.write(_answer(error))
        if under_way:
            cast(dict[str, Any], self.scope)[CLOSED_STATUS_SCOPE_KEY] = error.status
            self.cycle.disconnected = True  # what the application answers is not sent any more
            self.cycle.message_event.set()
        self.transport.close()


def address_group(address: str) -> str:
    """What counts as one address: of IPv6, the /64 that one customer or machine has."""
    try:
        found = ip_address(address.partition("%")[0])
    except ValueError:  # as a proxy named it
        return address
    if isinstance(found, IPv6Address):
        if found.ipv4_mapped is None:
            return str(ip_network((int(found), 64), strict=False))
        found = found.ipv4_mapped
    return str(found)


def raise_file_limit() -> int:
    """Let this process open as many files as the system allows (65,536 at most); how many."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_FILES)
    if soft == resource.RLIM_INFINITY or soft >= most:
        return MOST_FILES if soft == resource.RLIM_INFINITY else soft
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    except (OSError, ValueError):  # macOS allows less than it says
        return soft
    return most


def _answer(error: PlacewiseError) -> bytes:
    """A whole HTTP/1.1 answer with the problem."""
    body = json.dumps(error.as_problem()).encode()
    status = HTTPStatus(error.status)
    head = [
        f"HTTP/1.1 {status.value} {status.phrase}",
        "Content-Type: application/problem+json",
        f"Content-Length: {len(body)}",
        "Connection: close",
    ]
    if "retry_after_seconds" in error.extra:
        head.append(f"Retry-After: {error.extra['retry_after_seconds']}")
    return "\r\n".join(head).encode() + b"\r\n\r\n" + body
