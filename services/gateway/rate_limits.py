"""Rate limits of API keys: requests per minute.

The counters are in Redis, shared by all gateways, or in memory in the embedded server. While Redis
is unreachable, all requests are let through: the limits protect the service from overload and must
not make it unavailable.
"""

from __future__ import annotations

import logging
import math
import time

from limits import RateLimitItemPerMinute
from limits.errors import StorageError
from limits.storage import MemoryStorage, RedisStorage
from limits.strategies import SlidingWindowCounterRateLimiter
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.gateway.authentication import Caller
from shared.config.settings import Settings
from shared.errors import PlacewiseError, TooManyRequests
from shared.http.problem_details import problem_response

log = logging.getLogger(__name__)

REDIS_TIMEOUT_SECONDS = 0.25  # short: a slow Redis must not delay requests
REDIS_RETRY_SECONDS = 5.0  # after a failure, before Redis is tried again
KEY_PREFIX = "placewise:limits"


class RateLimiter:
    """Counts requests per key.

    Thread-safe; blocks for REDIS_TIMEOUT_SECONDS at most.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._counter = SlidingWindowCounterRateLimiter(_open_limit_storage(settings))
        self._redis_retry_at = 0.0

    def count_request(self, caller: Caller) -> dict[str, str]:
        """Count a request against the limit per minute.

        Returns:
            The RateLimit headers of the response; empty without a limit.

        Raises:
            TooManyRequests: `too_many_requests`.
        """
        limit = caller.limits.requests_per_minute or self._settings.key_requests_per_minute
        if caller.key_id is None or limit is None or time.monotonic() < self._redis_retry_at:
            return {}
        window, names = RateLimitItemPerMinute(limit), ("requests", str(caller.key_id))
        try:
            allowed = self._counter.hit(window, *names)
            reset_at, remaining = self._counter.get_window_stats(window, *names)
        except StorageError as error:
            if not self._redis_retry_at:
                log.warning(
                    "rate limits are off while Redis is unreachable: %s", error.storage_error
                )
            self._redis_retry_at = time.monotonic() + REDIS_RETRY_SECONDS
            return {}
        if self._redis_retry_at:
            self._redis_retry_at = 0.0
            log.warning("Redis is reachable again: rate limits are on")
        seconds = max(1, math.ceil(reset_at - time.time()))
        if not allowed:
            raise TooManyRequests(
                "too_many_requests",
                f"This key is limited to {limit} requests per minute. Retry after the seconds in "
                "Retry-After, or ask an admin for a key with a higher limit.",
                retry_after_seconds=seconds,
                limit=limit,
                remaining=remaining,
            )
        return {  # draft-ietf-httpapi-ratelimit-headers-10
            "RateLimit-Policy": f'"requests";q={limit};w={window.get_expiry()}',
            "RateLimit": f'"requests";r={remaining};t={seconds}',
        }


class RateLimitMiddleware:
    """Applies the rate limit of the key and adds the RateLimit headers to the response."""

    def __init__(self, app: ASGIApp, limiter: RateLimiter) -> None:
        self._app = app
        self._limiter = limiter

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        caller: Caller | None = scope.get("state", {}).get("caller")
        if scope["type"] != "http" or caller is None or caller.key_id is None:
            await self._app(scope, receive, send)
            return
        try:
            rate_limit_headers = await run_in_threadpool(self._limiter.count_request, caller)
        except PlacewiseError as error:
            await problem_response(error, Request(scope))(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(rate_limit_headers)
            await send(message)

        await self._app(scope, receive, send_with_headers)


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
