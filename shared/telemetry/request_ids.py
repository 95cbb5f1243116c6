"""The id of the current request.

The gateway takes it from `X-Request-ID` or creates one. It is stored in the job's row, and the
worker runs the job under the same id. Log lines and requests to search carry it.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from contextvars import ContextVar

from shared.ids import new_id

REQUEST_ID_HEADER = "X-Request-ID"
MAX_REQUEST_ID_CHARACTERS = 128
# Safe in every log, header and column without escaping.
REQUEST_ID_PATTERN = re.compile(rf"[A-Za-z0-9._:/+=@-]{{1,{MAX_REQUEST_ID_CHARACTERS}}}")

_request_id: ContextVar[str | None] = ContextVar("request_id", default=None)


def current_request_id() -> str | None:
    """Return the id of the current request; None outside of a request and its jobs."""
    return _request_id.get()


def request_id_or_new(request_id: str | None) -> str:
    """Return the client's request id if it is valid, else a new one."""
    if request_id is not None and REQUEST_ID_PATTERN.fullmatch(request_id):
        return request_id
    return str(new_id())


@contextlib.contextmanager
def request_id_context(request_id: str | None) -> Iterator[None]:
    """Set the current request id while the block runs; None for no request."""
    token = _request_id.set(request_id)
    try:
        yield
    finally:
        _request_id.reset(token)
