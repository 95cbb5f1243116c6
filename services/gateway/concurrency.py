"""A limit on calls of one kind that are under way: in all, of one key, and of one address."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator

from fastapi import Request

from services.gateway.authentication import get_caller
from services.http_connections import address_group
from shared.errors import TooManyRequests


class ConcurrencyLimit:
    """Counts the calls that hold a place. For the event loop only."""

    def __init__(
        self, what: str, code: str, *, total: int, per_caller: int, retry_after_seconds: int
    ) -> None:
        """`what` names the calls in the refusal, with the settings of both limits."""
        self._what = what
        self._code = code
        self._total = total
        self._per_caller = per_caller
        self._retry_after_seconds = retry_after_seconds
        self._of_caller: Counter[str] = Counter()
        self.count = 0

    @contextlib.contextmanager
    def hold(self, request: Request) -> Iterator[None]:
        """A place for the call, as long as the block lasts. TooManyRequests when there is none."""
        callers = _callers(request)
        if self.count >= self._total:
            raise self._refusal(f"{self._total} {self._what} are under way already.")
        for caller in callers:
            if self._of_caller[caller] >= self._per_caller:
                raise self._refusal(
                    f"{self._per_caller} {self._what} of this {caller.partition(' ')[0]} are under "
                    "way already."
                )
        self.count += 1
        self._of_caller.update(callers)
        try:
            yield
        finally:
            self.count -= 1
            self._of_caller.subtract(callers)
            self._of_caller += Counter()  # forgets who holds none

    def _refusal(self, detail: str) -> TooManyRequests:
        return TooManyRequests(
            self._code,
            f"{detail} Call again in a moment.",
            retry_after_seconds=self._retry_after_seconds,
        )


def _callers(request: Request) -> list[str]:
    """The call's key and address. ADMIN_KEY is no row of the catalog, and counts by address."""
    key_id = get_caller(request).key_id
    callers = [] if key_id is None else [f"key {key_id}"]
    if request.client is not None:
        callers.append(f"address {address_group(request.client.host)}")
    return callers
