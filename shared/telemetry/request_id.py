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

REQUEST_ID_HEADER = "X-Request-ID"
MAX_REQUEST_ID_CHARACTERS = 128
# What every log, header and column takes as it stands.
REQUEST_ID_PATTERN = re.compile(rf"[A-Za-z0-9._:/+=@-]{{1,{MAX_REQUEST_ID_CHARACTERS}}}")

_request_id: ContextVar[str | None] = ContextVar("request_id", default=None)


def current_request_id() -> str | None:
    """None outside of a request and its work."""
    return _request_id.get()


def request_id_or_new(sent: str | None) -> str:
    """The caller's id where it can be used as it stands, else a fresh one."""
    return sent if sent is not None and REQUEST_ID_PATTERN.fullmatch(sent) else str(new_id())


@contextlib.contextmanager
def request_id_context(request_id: str | None) -> Iterator[None]:
    """What the block does, it does for that request; None: for nobody's."""
    token = _request_id.set(request_id)
    try:
        yield
    finally:
        _request_id.reset(token)
