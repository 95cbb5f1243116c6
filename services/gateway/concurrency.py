"""Concurrency limits for requests: in total, per API key and per client address."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator

from fastapi import Request

from services.gateway.authentication import get_caller
from services.http_connections import address_group
from shared.errors import TooManyRequests


class ConcurrencyLimit:
    """Limits concurrent requests of one kind. Must be used on the event loop only."""

    def __init__(
        self, what: str, code: str, *, total: int, per_caller: int, retry_after_seconds: int
    ) -> None:
        """Creates the limit.

        Args:
            what: Names the requests, and the settings of both limits, in error messages.
            code: Error code of the refusal.
            total: Limit for all callers together.
            per_caller: Limit for one API key, and for one client address.
            retry_after_seconds: Sent as `Retry-After`.
        """
        self._what = what
        self._code = code
        self._total = total
        self._per_caller = per_caller
        self._retry_after_seconds = retry_after_seconds
        self._count_by_caller: Counter[str] = Counter()
        self.count = 0

    @contextlib.contextmanager
    def hold(self, request: Request) -> Iterator[None]:
        """Counts the request while the block runs.

        Raises:
            TooManyRequests: The total limit or the limit of the caller is reached.
        """
        callers = _callers(request)
        if self.count >= self._total:
            raise self._refusal(f"The server is already handling {self._total} {self._what}.")
        for caller in callers:
            if self._count_by_caller[caller] >= self._per_caller:
                raise self._refusal(
                    f"The server is already handling {self._per_caller} {self._what} of this "
                    f"{caller.partition(' ')[0]}."
                )
        self.count += 1
        self._count_by_caller.update(callers)
        try:
            yield
        finally:
            self.count -= 1
            self._count_by_caller.subtract(callers)
            self._count_by_caller += Counter()  # removes callers whose count is 0

    def _refusal(self, detail: str) -> TooManyRequests:
        return TooManyRequests(
            self._code,
            f"{detail} Try again in a moment.",
            retry_after_seconds=self._retry_after_seconds,
        )


def _callers(request: Request) -> list[str]:
    """The request's key and address. ADMIN_KEY has no key id, so it is counted by address only."""
    key_id = get_caller(request).key_id
    callers = [] if key_id is None else [f"key {key_id}"]
    if request.client is not None:
        callers.append(f"address {address_group(request.client.host)}")
    return callers
