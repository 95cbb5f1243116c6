"""One call to one search worker, and what its failures mean."""

from __future__ import annotations

from typing import TypeVar

import httpx2
from pydantic import BaseModel, ValidationError

from shared.errors import PlacewiseError, error_from_response
from shared.search_protocol import SearchRequest, SearchResponse, SearchStatus
from shared.telemetry.request_id import REQUEST_ID_HEADER as REQUEST_HEADER
from shared.telemetry.request_id import current_request_id
from shared.telemetry.traces import current_traceparent

CONNECT_SECONDS = 1.0  # inside one network: who takes longer is away


Message = TypeVar("Message", bound=BaseModel)


class WorkerUnavailable(Exception):
    """The worker did not answer, or not as a search worker does. `silent`: it took the call, and
    let its time run out."""

    def __init__(self, url: str, reason: str, *, silent: bool = False) -> None:
        super().__init__(f"{url}: {reason}")
        self.silent = silent


def call_search(
    http: httpx2.Client, url: str, request: SearchRequest, timeout_seconds: float
) -> SearchResponse:
    """The worker's answer. Raises WorkerAway, or the PlacewiseError that it answered with."""
    body = _call(
        http,
        "POST",
        f"{url}/search",
        timeout_seconds,
        content=request.as_json(),
    )
    return _read(SearchResponse, url, body)


def fetch_status(http: httpx2.Client, url: str, timeout_seconds: float) -> SearchStatus:
    """What the worker holds. Raises as `ask` does."""
    return _read(SearchStatus, url, _call(http, "GET", f"{url}/status", timeout_seconds))


def _read(kind: type[Message], url: str, body: bytes) -> Message:
    try:
        return kind.model_validate_json(body)
    except ValidationError as error:
        raise WorkerUnavailable(url, f"no {kind.__name__} came back") from error


def _call(
    http: httpx2.Client,
    method: str,
    url: str,
    timeout_seconds: float,
    content: str | None = None,
) -> bytes:
    headers = {"Content-Type": "application/json"} if content is not None else {}
    request_id = current_request_id()
    if request_id is not None:
        headers[REQUEST_HEADER] = request_id
    traceparent = current_traceparent()
    if traceparent is not None:
        headers["traceparent"] = traceparent
    timeout = httpx2.Timeout(timeout_seconds, connect=min(CONNECT_SECONDS, timeout_seconds))
    try:
        answer = http.request(method, url, timeout=timeout, content=content, headers=headers)
    except httpx2.TransportError as error:
        silent = isinstance(error, httpx2.ReadTimeout)
        raise WorkerUnavailable(url, type(error).__name__, silent=silent) from error
    if answer.is_success:
        return answer.content
    said = error_from_response(answer.status_code, answer.text)
    # A proxy's page, or the worker's own fault.
    if said.code == "bad_answer" or type(said) is PlacewiseError:
        raise WorkerUnavailable(url, said.detail)
    raise said
