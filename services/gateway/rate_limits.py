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

from services.gateway.authentication import Caller
from shared.config.settings import Settings
from shared.errors import InvalidRequest, LengthRequired, PlacewiseError, TooManyRequests
from shared.http.problem_details import problem_response

log = logging.getLogger(__name__)

REDIS_TIMEOUT_SECONDS = 0.25  # longest wait for Redis: a call is worth more than its count
REDIS_RETRY_SECONDS = 5.0  # in which a Redis that was away is not asked again
KEY_PREFIX = "placewise:limits"


@dataclass(frozen=True, slots=True)
class RateLimit:
    """One limit of one key. `name` is the policy's in the RateLimit headers."""

    name: str
    window: RateLimitItem
    code: str
    message: str


class RateLimiter:
    """Counts what keys do. Thread-safe; blocks for REDIS_SECONDS at most."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._shared = settings.redis_url is not None
        self._counter = SlidingWindowCounterRateLimiter(_open_limit_storage(settings))
        self._redis_retry_at = 0.0

    def count_request(self, caller: Caller) -> dict[str, str]:
        """Count a call; what its answer says of the limit. TooManyRequests
        (`too_many_requests`)."""
        most = caller.limits.requests_per_minute or self._settings.key_requests_per_minute
        if caller.key_id is None or most is None:
            return {}
        quota = RateLimit(
            "requests",
            RateLimitItemPerMinute(most),
            "too_many_requests",
            f"This key may make {most} calls a minute.",
        )
        return self._hit(caller, quota, 1)

    def count_upload_bytes(self, caller: Caller, size_bytes: int) -> dict[str, str]:
        """Count what is about to be sent. TooManyRequests (`upload_quota_reached`)."""
        most = self.daily_upload_bytes(caller)
        if most is None or not size_bytes:
            return {}
        quota = RateLimit(
            "upload-bytes",
            RateLimitItemPerDay(most),
            "upload_quota_reached",
            f"This key may send {most} bytes a day, and this call has {size_bytes}.",
        )
        return self._hit(caller, quota, size_bytes)

    def daily_upload_bytes(self, caller: Caller) -> int | None:
        """Bytes that the caller may send in a day; None for any number."""
        if caller.key_id is None:
            return None
        return caller.limits.upload_bytes_per_day or self._settings.key_upload_bytes_per_day

    def _hit(self, caller: Caller, quota: RateLimit, cost: int) -> dict[str, str]:
        if time.monotonic() < self._redis_retry_at:
            return {}
        names = (quota.name, str(caller.key_id))
        try:
            taken = self._counter.hit(quota.window, *names, cost=cost)
            reset_at, remaining = self._counter.get_window_stats(quota.window, *names)
        except StorageError as error:
            if not self._redis_retry_at:
                log.warning("keys are not limited while Redis is away: %s", error.storage_error)
            self._redis_retry_at = time.monotonic() + REDIS_RETRY_SECONDS
            return {}
        if self._redis_retry_at:
            self._redis_retry_at = 0.0
            log.warning("Redis is back: keys are limited again")
        seconds = max(1, math.ceil(reset_at - time.time()))
        headers = _rate_limit_headers(quota, remaining, seconds)
        if not taken:
            raise TooManyRequests(
                quota.code,
                f"{quota.message} Come again after the time in Retry-After, or ask an admin "
                "for a key "
                "with a higher limit.",
                retry_after_seconds=seconds,
                limit=quota.window.amount,
                remaining=remaining,
            )
        return headers


class RateLimitMiddleware:
    """Lets a call through while its key's limits do, and says in the answer how far they are."""

    def __init__(self, app: ASGIApp, limiter: RateLimiter) -> None:
        self._app = app
        self._limiter = limiter

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        caller: Caller | None = scope.get("state", {}).get("caller")
        if scope["type"] != "http" or caller is None or caller.key_id is None:
            await self._app(scope, receive, send)
            return
        try:
            size_bytes = self._content_length(caller, Headers(scope=scope))
            said = await run_in_threadpool(self._count_call, caller, size_bytes)
        except PlacewiseError as error:
            await problem_response(error, Request(scope))(scope, receive, send)
            return

        async def tell(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(said)
            await send(message)

        await self._app(scope, receive, tell)

    def _count_call(self, caller: Caller, size_bytes: int) -> dict[str, str]:
        said = self._limiter.count_request(caller)
        self._limiter.count_upload_bytes(caller, size_bytes)
        return said

    def _content_length(self, caller: Caller, headers: Headers) -> int:
        """Bytes of the body, as the head of the call says. LengthRequired where that is to be
        counted and not said."""
        said = headers.get("content-length")
        if said is not None:
            if not said.isdecimal():
                raise InvalidRequest("malformed_body", "Content-Length is no number.")
            return int(said)
        if "transfer-encoding" in headers and self._limiter.daily_upload_bytes(caller) is not None:
            raise LengthRequired(
                "length_required",
                "The bytes that this key sends are counted: say how many there are in "
                "Content-Length.",
            )
        return 0


def _rate_limit_headers(quota: RateLimit, remaining: int, seconds: int) -> dict[str, str]:
    """As the IETF's draft-ietf-httpapi-ratelimit-headers-10 has them."""
    window = quota.window.get_expiry()
    return {
        "RateLimit-Policy": f'"{quota.name}";q={quota.window.amount};w={window}',
        "RateLimit": f'"{quota.name}";r={remaining};t={seconds}',
    }


def _open_limit_storage(settings: Settings) -> MemoryStorage | RedisStorage:
    if settings.redis_url is None:
        return MemoryStorage()
    return RedisStorage(
        settings.redis_url.get_secret_value(),
        key_prefix=KEY_PREFIX,
        wrap_exceptions=True,
        socket_timeout=REDIS_TIMEOUT_SECONDS,
        socket_connect_timeout=REDIS_TIMEOUT_SECONDS,
    )
