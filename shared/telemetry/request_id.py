"""The id of the request that is being answered, or that the work at hand was asked for by.

The gateway takes it from `X-Request-ID` or makes one. Whoever does a request's job does it under
the same id: it is kept in the job's row. Log lines, spans and calls to search carry it.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from contextvars import ContextVar

from shared.ids import new_id

HEADER = "X-Request-ID"
MOST_CHARACTERS = 128
# What every log, header and column takes as it stands.
GOOD = re.compile(rf"[A-Za-z0-9._:/+=@-]{{1,{MOST_CHARACTERS}}}")

_current: ContextVar[str | None] = ContextVar("request_id", default=None)


def current_request_id() -> str | None:
    """None outside of a request and its work."""
    return _current.get()


def accept_request_id(sent: str | None) -> str:
    """The caller's id where it can be used as it stands, else a fresh one."""
    return sent if sent is not None and GOOD.fullmatch(sent) else str(new_id())


@contextlib.contextmanager
def under_request_id(request_id: str | None) -> Iterator[None]:
    """What the block does, it does for that request; None: for nobody's."""
    token = _current.set(request_id)
    try:
        yield
    finally:
        _current.reset(token)
