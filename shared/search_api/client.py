"""HTTP client of the search workers, each of which holds everything.

`HttpSearchClient` calls one worker, and another one when that fails. `WorkerDirectory`
(`shared.search_api.workers`) knows which of them can answer.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Self, TypeVar

import httpx2
from opentelemetry import propagate
from pydantic import BaseModel, ValidationError

from shared.config.settings import Settings
from shared.errors import Misconfigured, PlacewiseError, Unavailable, error_from_response
from shared.search_api.protocol import (
    MatchRequest,
    MatchResponse,
    PoseRequest,
    PoseResponse,
    SearchRequest,
    SearchResponse,
    SearchStatus,
)
from shared.search_api.workers import REFRESH_SECONDS, WorkerDirectory, WorkerUnavailable
from shared.telemetry.request_ids import REQUEST_ID_HEADER, current_request_id

log = logging.getLogger(__name__)

Message = TypeVar("Message", bound=BaseModel)


SEARCH_TIMEOUT_SECONDS = 10.0
MAX_KEPT_CONNECTIONS = 64
RETRY_PAUSE_SECONDS = 0.05  # before lagging workers are called again

BEHIND = "search_behind"
NO_ANSWER = "search_unavailable"


class HttpSearchClient:
    """`SearchBackend` over HTTP for all search workers; a context manager, thread-safe.

    One worker is called, and the next one when that fails.

    Raises:
        Gone, NotFound: As the workers raise them.
        Unavailable: `chunk_unreadable` and `engine_unavailable` as the workers raise them;
            `search_behind` when none reaches `min_version` in time; `search_unavailable` when none
            answers.
    """

    def __init__(self, urls: Sequence[str], timeout_seconds: float) -> None:
        self._timeout_seconds = timeout_seconds
        self._http = httpx2.Client(
            limits=httpx2.Limits(max_keepalive_connections=MAX_KEPT_CONNECTIONS),
            trust_env=False,  # a proxy that the environment names is for other networks
        )
        self._workers = WorkerDirectory(urls, partial(fetch_status, self._http))
        self._stop = threading.Event()
        self._refresh_thread = threading.Thread(
            target=self._refresh_workers, name="search-workers", daemon=True
        )

    @classmethod
    def from_settings(cls, settings: Settings) -> Self:
        """Create the client of SEARCH_URLS; Misconfigured (`search_missing`) if it is not set."""
        if not settings.search_worker_urls:
            raise Misconfigured(
                "search_missing",
                "SEARCH_URLS is not set. List the URL of every search worker, for example "
                "http://search-1:8000,http://search-2:8000.",
            )
        return cls(settings.search_worker_urls, SEARCH_TIMEOUT_SECONDS)

    def __enter__(self) -> Self:
        self._workers.refresh()
        self._refresh_thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._refresh_thread.join()
        self._workers.close()
        self._http.close()

    def _refresh_workers(self) -> None:
        while not self._stop.wait(REFRESH_SECONDS):
            self._workers.refresh()

    def search(self, request: SearchRequest) -> SearchResponse:
        """Search on one worker; on the next one when it fails.

        Workers that lag behind are called again until the time is over.
        """
        deadline = time.monotonic() + self._timeout_seconds
        behind: Unavailable | None = None
        while not self._stop.is_set():
            urls = self._workers.urls(request.generation_id, request.min_version)
            try:
                return self._call_any(urls, "search", request, SearchResponse, deadline)
            except Unavailable as error:
                if error.code == BEHIND:  # a worker may answer in a moment
                    behind = error
                elif error.code != NO_ANSWER or behind is None:
                    raise
            if time.monotonic() + RETRY_PAUSE_SECONDS > deadline:
                raise behind
            time.sleep(RETRY_PAUSE_SECONDS)
        raise Unavailable(NO_ANSWER, "The server is stopping. Retry in a moment.")

    def match(self, request: MatchRequest) -> MatchResponse:
        """Match local features on one worker; on the next one when it fails."""
        return self._call_any(self._workers.urls(), "match", request, MatchResponse)

    def estimate_pose(self, request: PoseRequest) -> PoseResponse:
        """Compute a pose on one worker; on the next one when it fails."""
        return self._call_any(self._workers.urls(), "pose", request, PoseResponse)

    def _call_any(
        self,
        urls: list[str],
        path: str,
        request: BaseModel,
        kind: type[Message],
        deadline: float | None = None,
    ) -> Message:
        """Return the first answer; raises what a worker refused with, if none answers."""
        deadline = deadline or time.monotonic() + self._timeout_seconds
        refused = _no_answer()
        for url, seconds in _attempts(urls, deadline):
            try:
                return call_worker(self._http, f"{url}/{path}", request, kind, seconds)
            except WorkerUnavailable as error:
                log.info("a %s request failed, trying the next worker: %s", path, error)
                self._workers.mark_down(url)
            except Unavailable as error:
                log.debug("%s: %s", url, error.detail)
                if refused.code in (NO_ANSWER, BEHIND):
                    refused = error
        raise refused

    def status(self) -> SearchStatus:
        """Poll the workers and return the state of the most advanced one.

        Raises:
            Unavailable: `search_unavailable` if no worker answers.
        """
        self._workers.refresh()
        status = self._workers.best_status()
        if status is None:
            raise _no_answer()
        return status


def _no_answer() -> Unavailable:
    return Unavailable(NO_ANSWER, "No search worker answers. Retry in a moment.")


def _attempts(urls: Sequence[str], deadline: float) -> Iterator[tuple[str, float]]:
    """Yield the workers to call, each with its timeout in seconds, until the deadline."""
    # A lone worker gets a second attempt: the kept-alive connection may have been stale.
    order = list(urls) if len(urls) != 1 else [urls[0], urls[0]]
    for url in order:
        remaining = deadline - time.monotonic()
        if remaining <= 0:
            return
        # Only the last worker may use up the whole remaining time.
        yield url, remaining if url == order[-1] else remaining / 2


CONNECT_SECONDS = 1.0  # workers are in the same network: a slower one counts as unreachable
STATUS_TIMEOUT_SECONDS = 2.0  # a worker that answers more slowly gets no queries


def call_worker(
    http: httpx2.Client, url: str, request: BaseModel, kind: type[Message], timeout_seconds: float
) -> Message:
    """Post a request to one worker.

    Raises:
        WorkerUnavailable: The worker could not be reached, or failed.
        PlacewiseError: As the worker answered it.
    """
    body = _call(http, "POST", url, timeout_seconds, content=request.model_dump_json())
    return _read(kind, url, body)


def fetch_status(
    http: httpx2.Client, url: str, timeout_seconds: float = STATUS_TIMEOUT_SECONDS
) -> SearchStatus:
    """Call `GET /status` of one worker; raises as `call_worker` does."""
    return _read(SearchStatus, url, _call(http, "GET", f"{url}/status", timeout_seconds))


def _read(kind: type[Message], url: str, body: bytes) -> Message:
    try:
        return kind.model_validate_json(body)
    except ValidationError as error:
        raise WorkerUnavailable(url, f"the response is not a {kind.__name__}") from error


def _call(
    http: httpx2.Client, method: str, url: str, timeout_seconds: float, content: str | None = None
) -> bytes:
    headers = {"Content-Type": "application/json"} if content is not None else {}
    request_id = current_request_id()
    if request_id is not None:
        headers[REQUEST_ID_HEADER] = request_id
    propagate.inject(headers)  # the trace, if FastAPI traces the request
    timeout = httpx2.Timeout(timeout_seconds, connect=min(CONNECT_SECONDS, timeout_seconds))
    try:
        response = http.request(method, url, timeout=timeout, content=content, headers=headers)
    except httpx2.RequestError as error:
        silent = isinstance(error, httpx2.ReadTimeout)
        raise WorkerUnavailable(url, type(error).__name__, silent=silent) from error
    if response.is_success:
        return response.content
    problem = error_from_response(response.status_code, response.text)
    # A proxy's error page, or an internal error of the worker.
    if problem.code == "bad_answer" or type(problem) is PlacewiseError:
        raise WorkerUnavailable(url, problem.detail)
    raise problem
