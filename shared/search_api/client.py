"""HTTP client of the search tier: fans a query out to all shards and merges their responses.

`HttpSearchClient` calls one worker of each shard concurrently, retries other workers of the shard,
and merges what comes back. `WorkerDirectory` (`shared.search_api.workers`) knows which worker
serves which shard. A single worker that holds everything is the case of one shard.
"""

from __future__ import annotations

import heapq
import logging
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextvars import copy_context
from functools import partial
from typing import Self, TypeVar
from uuid import UUID

import httpx2
from pydantic import BaseModel, ValidationError

from shared.config.settings import Settings
from shared.config.shards import Shard
from shared.errors import Misconfigured, PlacewiseError, Unavailable, error_from_response
from shared.search_api.protocol import (
    CERTIFICATES,
    NONE,
    MatchRequest,
    MatchResponse,
    PoseRequest,
    PoseResponse,
    SearchHit,
    SearchRequest,
    SearchResponse,
    SearchStatus,
)
from shared.search_api.workers import REFRESH_SECONDS, WorkerDirectory, WorkerUnavailable
from shared.telemetry.tracing import REQUEST_ID_HEADER, current_request_id, current_traceparent

log = logging.getLogger(__name__)

Message = TypeVar("Message", bound=BaseModel)


def merge_responses(
    responses: Sequence[SearchResponse], k: int, unreachable: Iterable[Shard] = ()
) -> SearchResponse:
    """Merge the responses of the shards into one with the best `k` hits.

    Counts are summed; the version is the lowest, the certificate the weakest. `unreachable` shards
    are named in `missing`; nothing is certified in a response that lacks anything.
    """
    hits = _top_hits(k, responses)
    missing = (
        *(key for response in responses for key in response.missing),
        *(shard.name for shard in sorted(unreachable)),
    )
    weakest = max((response.certificate for response in responses), key=_certificate_rank)
    return SearchResponse(
        hits=tuple(hits),
        max_z=max(
            (response.max_z for response in responses if response.max_z is not None), default=None
        ),
        certificate=NONE if missing else weakest,
        rows_scanned=sum(response.rows_scanned for response in responses),
        rows_reranked=sum(response.rows_reranked for response in responses),
        snapshot_version=min(response.snapshot_version for response in responses),
        missing=missing,
    )


def _top_hits(k: int, responses: Sequence[SearchResponse]) -> list[SearchHit]:
    """The best `k` hits of responses that are sorted each: by `score`, ties by photo id."""
    merged = heapq.merge(
        *(response.hits for response in responses), key=lambda hit: (-hit.score, hit.photo_id)
    )
    hits: dict[UUID, SearchHit] = {}
    for hit in merged:
        if len(hits) == k:
            break
        # Shards may be at different versions, between which a photo has moved.
        hits.setdefault(hit.photo_id, hit)
    return list(hits.values())


def _certificate_rank(certificate: str) -> int:
    """Rank of a certificate; an unknown one, of a newer worker, counts as the weakest."""
    known = certificate in CERTIFICATES
    return CERTIFICATES.index(certificate) if known else len(CERTIFICATES)


def merge_statuses(
    shards: Mapping[Shard, SearchStatus], unreachable: Iterable[Shard] = ()
) -> SearchStatus:
    """Merge the shards' states; a generation counts as loaded once every shard has loaded it."""
    statuses = list(shards.values())
    common = set.intersection(*(set(status.versions) for status in statuses)) if statuses else set()
    lagging = {key for status in statuses for key in status.lags}
    return SearchStatus(
        rows=sum(status.rows for status in statuses),
        resident_bytes=sum(status.resident_bytes for status in statuses),
        mapped_bytes=sum(status.mapped_bytes for status in statuses),
        versions={key: min(status.versions[key] for status in statuses) for key in common},
        incomplete=tuple(sorted({key for status in statuses for key in status.incomplete})),
        missing=tuple(key for status in statuses for key in status.missing),
        disk_full=any(status.disk_full for status in statuses),
        lags={
            key: max(
                (status.lags[key] for status in statuses if key in status.lags),
                key=lambda lag: lag.seconds,
            )
            for key in lagging
        },
        unavailable=tuple(shard.name for shard in sorted(unreachable)),
    )


SHARD_TIMEOUT_SECONDS = 10.0  # a shard that takes longer is left out of the result and named
MAX_CONCURRENT_CALLS = 64  # to all shards together; further calls are queued
RESPONSE_MARGIN_SECONDS = 0.2  # for a call that times out at the deadline to return its error
RETRY_PAUSE_SECONDS = 0.05  # before lagging workers are called again

BEHIND, UNREADABLE = "search_behind", "chunk_unreadable"


class HttpSearchClient:
    """`SearchBackend` over HTTP for all search workers; a context manager, thread-safe.

    One worker of each shard is called, and the next one when that fails. A shard without a worker
    that answers in time is named in the response's `missing`; the other shards' hits are returned.

    Raises:
        Gone, NotFound: As the workers raise them.
        Unavailable: `chunk_unreadable` as the workers raise it; `search_behind` when no shard
            reaches `min_version` in time; `search_unavailable` when no shard answers.
    """

    def __init__(self, urls: Sequence[str], timeout_seconds: float) -> None:
        self._timeout_seconds = timeout_seconds
        self._http = httpx2.Client(
            limits=httpx2.Limits(max_keepalive_connections=MAX_CONCURRENT_CALLS)
        )
        self._workers = WorkerDirectory(urls, partial(fetch_status, self._http))
        self._call_executor = ThreadPoolExecutor(
            MAX_CONCURRENT_CALLS, thread_name_prefix="search-call"
        )
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
        return cls(settings.search_worker_urls, SHARD_TIMEOUT_SECONDS)

    def __enter__(self) -> Self:
        self._workers.refresh()
        self._refresh_thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._refresh_thread.join()
        self._call_executor.shutdown(cancel_futures=True)
        self._workers.close()
        self._http.close()

    def _refresh_workers(self) -> None:
        while not self._stop.wait(REFRESH_SECONDS):
            self._workers.refresh()

    def search(self, request: SearchRequest) -> SearchResponse:
        """Search all shards and merge the responses."""
        deadline = time.monotonic() + self._timeout_seconds
        layout = self._workers.layout(request.generation_id, request.min_version)
        if not layout:  # no worker has answered yet
            self._workers.refresh()
            layout = self._workers.layout(request.generation_id, request.min_version)
        calls = {
            shard: self._submit_call(shard, urls, request, deadline)
            for shard, urls in layout.items()
        }
        wait(calls.values(), timeout=deadline + RESPONSE_MARGIN_SECONDS - time.monotonic())
        responses, unreachable, behind = _collect(calls)
        if not responses:
            raise behind or Unavailable(
                "search_unavailable", "No search worker answers. Retry in a moment."
            )
        return merge_responses(responses, request.k, unreachable)

    def match(self, request: MatchRequest) -> MatchResponse:
        """Match local features on one worker; on the next one when it fails."""
        return self._call_any("match", request, MatchResponse)

    def estimate_pose(self, request: PoseRequest) -> PoseResponse:
        """Compute a pose on one worker; on the next one when it fails."""
        return self._call_any("pose", request, PoseResponse)

    def _call_any(self, path: str, request: BaseModel, kind: type[Message]) -> Message:
        deadline = time.monotonic() + self._timeout_seconds
        for url, seconds in _attempts(self._workers.urls(), deadline):
            try:
                return _post(self._http, f"{url}/{path}", request, kind, seconds)
            except WorkerUnavailable as error:
                log.info("a %s request failed, trying the next worker: %s", path, error)
                self._workers.mark_down(url)
        raise Unavailable("search_unavailable", "No search worker answers. Retry in a moment.")

    def status(self) -> SearchStatus:
        """Poll the workers and merge their states.

        Raises:
            Unavailable: `search_unavailable` if no worker answers.
        """
        self._workers.refresh()
        statuses, unreachable = self._workers.statuses()
        if not statuses:
            raise Unavailable("search_unavailable", "No search worker answers.")
        return merge_statuses(statuses, unreachable)

    def _submit_call(
        self, shard: Shard, urls: Sequence[str], request: SearchRequest, deadline: float
    ) -> Future[SearchResponse]:
        # In the request's context, so that its id and trace are propagated.
        run = copy_context().run
        try:
            return self._call_executor.submit(
                run, self._search_shard, shard, urls, request, deadline
            )
        except RuntimeError as error:  # the executor was shut down
            raise Unavailable(
                "search_unavailable", "The server is stopping. Retry in a moment."
            ) from error

    def _search_shard(
        self, shard: Shard, urls: Sequence[str], request: SearchRequest, deadline: float
    ) -> SearchResponse:
        """Return the response of one of the shard's workers; WorkerUnavailable if none answers.

        Lagging workers are called again until the deadline.
        """
        behind: Unavailable | None = None
        while True:
            retry = False
            unreadable: Unavailable | None = None
            for url, seconds in _attempts(urls, deadline):
                try:
                    return call_search(self._http, url, request, seconds)
                except WorkerUnavailable as error:
                    log.info("a call for %s failed, trying the next worker: %s", shard.name, error)
                    self._workers.mark_down(url)
                except Unavailable as error:
                    log.debug("%s: %s: %s", shard.name, url, error.detail)
                    if error.code == BEHIND:  # the worker may answer in a moment
                        behind, retry = error, True
                    elif error.code == UNREADABLE:
                        unreadable = error
            if unreadable is not None:
                raise unreadable  # permanent, and no other worker could answer
            if not retry or time.monotonic() + RETRY_PAUSE_SECONDS > deadline:
                # A worker that lagged and then timed out is reported as lagging.
                raise behind or WorkerUnavailable(shard.name, "no worker answers")
            time.sleep(RETRY_PAUSE_SECONDS)


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


def _collect(
    calls: dict[Shard, Future[SearchResponse]],
) -> tuple[list[SearchResponse], list[Shard], Unavailable | None]:
    """Return the responses, the shards without one, and the error of a lagging shard, if any.

    Other errors of a shard are raised: they concern the query, not the shard.
    """
    responses: list[SearchResponse] = []
    unreachable: list[Shard] = []
    behind: Unavailable | None = None
    for shard, call in calls.items():
        try:
            responses.append(call.result(timeout=0))
        except (WorkerUnavailable, TimeoutError, CancelledError):  # cancelled: the client is closed
            call.cancel()
            unreachable.append(shard)
        except Unavailable as error:
            if error.code != BEHIND:
                raise
            behind = error
            unreachable.append(shard)
    return responses, unreachable, behind


CONNECT_SECONDS = 1.0  # workers are in the same network: a slower one counts as unreachable
STATUS_TIMEOUT_SECONDS = 2.0  # a worker that answers more slowly gets no queries


def call_search(
    http: httpx2.Client, url: str, request: SearchRequest, timeout_seconds: float
) -> SearchResponse:
    """Call `POST /search` of one worker.

    Raises:
        WorkerUnavailable: The worker could not be reached, or failed.
        PlacewiseError: As the worker answered it.
    """
    return _post(http, f"{url}/search", request, SearchResponse, timeout_seconds)


def _post(
    http: httpx2.Client,
    url: str,
    request: BaseModel,
    kind: type[Message],
    timeout_seconds: float,
) -> Message:
    body = _call(http, "POST", url, timeout_seconds, content=request.model_dump_json())
    return _read(kind, url, body)


def fetch_status(
    http: httpx2.Client, url: str, timeout_seconds: float = STATUS_TIMEOUT_SECONDS
) -> SearchStatus:
    """Call `GET /status` of one worker; raises as `call_search` does."""
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
    traceparent = current_traceparent()
    if traceparent is not None:
        headers["traceparent"] = traceparent
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
