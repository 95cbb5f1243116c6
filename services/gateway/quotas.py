"""How much a key may do: calls in a minute, bytes in a day.

Counted where every gateway sees it: in Redis; in this process when embedded. While Redis is away
nothing is counted and every call is let through: limits protect a service from too much, and are
no reason to be away with it.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass

from limits import RateLimitItem, RateLimitItemPerDay, RateLimitItemPerMinute
from limits.errors import StorageError
from limits.storage import MemoryStorage, RedisStorage
from limits.strategies import SlidingWindowCounterRateLimiter
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.gateway.keys import Caller
from shared.errors import InvalidRequest, LengthRequired, PlacewiseError, TooManyRequests
from shared.problems import problem_response
from shared.settings import Settings

log = logging.getLogger(__name__)

REDIS_SECONDS = 0.25  # longest wait for Redis: a call is worth more than its count
AWAY_SECONDS = 5.0  # in which a Redis that was away is not asked again
KEY_PREFIX = "placewise:limits"


@dataclass(frozen=True, slots=True)
class Quota:
    """One limit of one key. `name` is the policy's in the RateLimit headers."""

    name: str
    item: RateLimitItem
    code: str
    says: str


class Quotas:
    """Counts what keys do. Thread-safe; blocks for REDIS_SECONDS at most."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._shared = settings.redis_url is not None
        self._counter = SlidingWindowCounterRateLimiter(_storage(settings))
        self._away_until = 0.0

    def take_request(self, caller: Caller) -> dict[str, str]:
        """Count a call; what its answer says of the limit. TooManyRequests
        (`too_many_requests`)."""
        most = caller.limits.requests_per_minute or self._settings.key_requests_per_minute
        if caller.key_id is None or most is None:
            return {}
        quota = Quota(
            "requests",
            RateLimitItemPerMinute(most),
            "too_many_requests",
            f"This key may make {most} calls a minute.",
        )
        return self._take(caller, quota, 1)

    def take_bytes(self, caller: Caller, size_bytes: int) -> dict[str, str]:
        """Count what is about to be sent. TooManyRequests (`upload_quota_reached`)."""
        most = self.upload_bytes_of(caller)
        if most is None or not size_bytes:
            return {}
        quota = Quota(
            "upload-bytes",
            RateLimitItemPerDay(most),
            "upload_quota_reached",
            f"This key may send {most} bytes a day, and this call has {size_bytes}.",
        )
        return self._take(caller, quota, size_bytes)

    def upload_bytes_of(self, caller: Caller) -> int | None:
        """Bytes that the caller may send in a day; None for any number."""
        if caller.key_id is None:
            return None
        return caller.limits.upload_bytes_per_day or self._settings.key_upload_bytes_per_day

    def _take(self, caller: Caller, quota: Quota, cost: int) -> dict[str, str]:
        if time.monotonic() < self._away_until:
            return {}
        names = (quota.name, str(caller.key_id))
        try:
            taken = self._counter.hit(quota.item, *names, cost=cost)
            reset_at, remaining = self._counter.get_window_stats(quota.item, *names)
        except StorageError as error:
            if not self._away_until:
                log.warning("keys are not limited while Redis is away: %s", error.storage_error)
            self._away_until = time.monotonic() + AWAY_SECONDS
            return {}
        if self._away_until:
            self._away_until = 0.0
            log.warning("Redis is back: keys are limited again")
        seconds = max(1, math.ceil(reset_at - time.time()))
        headers = _headers(quota, remaining, seconds)
        if not taken:
            raise TooManyRequests(
                quota.code,
                f"{quota.says} Come again after the time in Retry-After, or ask an admin for a key "
                "with a higher limit.",
                retry_after_seconds=seconds,
                limit=quota.item.amount,
                remaining=remaining,
            )
        return headers


class Metered:
    """Lets a call through while its key's limits do, and says in the answer how far they are."""

    def __init__(self, app: ASGIApp, quotas: Quotas) -> None:
        self._app = app
        self._quotas = quotas

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        caller: Caller | None = scope.get("state", {}).get("caller")
        if scope["type"] != "http" or caller is None or caller.key_id is None:
            await self._app(scope, receive, send)
            return
        try:
            size_bytes = self._announced(caller, Headers(scope=scope))
            said = await run_in_threadpool(self._take, caller, size_bytes)
        except PlacewiseError as error:
            await problem_response(error, Request(scope))(scope, receive, send)
            return

        async def tell(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(said)
            await send(message)

        await self._app(scope, receive, tell)

    def _take(self, caller: Caller, size_bytes: int) -> dict[str, str]:
        said = self._quotas.take_request(caller)
        self._quotas.take_bytes(caller, size_bytes)
        return said

    def _announced(self, caller: Caller, headers: Headers) -> int:
        """Bytes of the body, as the head of the call says. LengthRequired where that is to be
        counted and not said."""
        said = headers.get("content-length")
        if said is not None:
            if not said.isdecimal():
                raise InvalidRequest("malformed_body", "Content-Length is no number.")
            return int(said)
        if "transfer-encoding" in headers and self._quotas.upload_bytes_of(caller) is not None:
            raise LengthRequired(
                "length_required",
                "The bytes that this key sends are counted: say how many there are in "
                "Content-Length.",
            )
        return 0


def _headers(quota: Quota, remaining: int, seconds: int) -> dict[str, str]:
    """As the IETF's draft-ietf-httpapi-ratelimit-headers-10 has them."""
    window = quota.item.get_expiry()
    return {
        "RateLimit-Policy": f'"{quota.name}";q={quota.item.amount};w={window}',
        "RateLimit": f'"{quota.name}";r={remaining};t={seconds}',
    }


def _storage(settings: Settings) -> MemoryStorage | RedisStorage:
    if settings.redis_url is None:
        return MemoryStorage()
    return RedisStorage(
        settings.redis_url.get_secret_value(),
        key_prefix=KEY_PREFIX,
        wrap_exceptions=True,
        socket_timeout=REDIS_SECONDS,
        socket_connect_timeout=REDIS_SECONDS,
    )
