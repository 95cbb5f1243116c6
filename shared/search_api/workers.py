"""Who serves which shard: what the workers' own `/status` says, looked at about every second.

One call to one search worker, and what its failures mean.
"""

from __future__ import annotations

import logging
import random
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar
from uuid import UUID

import httpx2
from pydantic import BaseModel, ValidationError

from shared.config.shards import Shard
from shared.errors import PlacewiseError, error_from_response
from shared.search_api.protocol import SearchRequest, SearchResponse, SearchStatus
from shared.telemetry.tracing import REQUEST_ID_HEADER as REQUEST_HEADER
from shared.telemetry.tracing import current_request_id, current_traceparent

log = logging.getLogger(__name__)

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


REFRESH_SECONDS = 1.0  # between two looks at every worker
STATUS_TIMEOUT_SECONDS = 2.0  # a worker that takes longer to say what it holds is not asked


@dataclass(slots=True)
class WorkerState:
    """What is known of one worker. `status` is what it said last, however long ago."""

    url: str
    status: SearchStatus | None = None
    is_up: bool = False
    silent: bool = False
    """Its time ran out: asking it would cost a query all of its own."""

    @property
    def shard(self) -> Shard | None:
        return None if self.status is None else Shard.parse(self.status.shard)

    def version(self, generation_id: UUID) -> int:
        """The version of the generation that it had when it was looked at; -1 for none."""
        return -1 if self.status is None else self.status.versions.get(generation_id, -1)

    def lacks_chunks(self, generation_id: UUID) -> bool:
        """Whether it could not read a chunk of the generation: another replica may have it."""
        return self.status is not None and generation_id in self.status.incomplete


class WorkerDirectory:
    """The workers at these addresses; thread-safe."""

    def __init__(self, urls: Sequence[str], http: httpx2.Client) -> None:
        self._http = http
        self._lock = threading.Lock()
        self._workers = [WorkerState(url) for url in urls]
        self._looking = ThreadPoolExecutor(max(1, len(urls)), thread_name_prefix="search-status")

    def close(self) -> None:
        self._looking.shutdown()

    def look(self) -> None:
        """Ask every worker at once what it holds; takes as long as the slowest of them."""
        for _ in self._looking.map(self._refresh, self._workers):
            pass

    def _refresh(self, worker: WorkerState) -> None:
        status, silent, reason = None, False, ""
        try:
            status = fetch_status(self._http, worker.url, STATUS_TIMEOUT_SECONDS)
        except WorkerUnavailable as error:
            silent, reason = error.silent, str(error)
        except PlacewiseError as error:
            reason = error.detail
        with self._lock:
            known = worker.status is not None
            if worker.is_up and status is None:
                log.warning("a search worker is away: %s", reason)
            elif known and not worker.is_up and status is not None:
                log.info("the search worker %s is back, with shard %s", worker.url, status.shard)
            worker.is_up, worker.silent = status is not None, silent
            worker.status = status or worker.status

    def failed(self, url: str) -> None:
        """A call did not get through: others are asked first until the next look."""
        with self._lock:
            for worker in self._workers:
                if worker.url == url:
                    worker.is_up = False

    def layout(self, generation_id: UUID, min_version: int) -> dict[Shard, list[str]]:
        """Every shard with the workers to ask, the best first; {} while none is known.

        Workers of another number of shards may run beside these while a deployment changes it.
        Those are asked of which more shards have the generation; of equals, the larger number.
        """
        with self._lock:
            best = self._best_workers(generation_id)
            order = random.sample(best, len(best))  # replicas share the work
            order.sort(
                key=lambda worker: (
                    not worker.is_up,
                    worker.version(generation_id) < min_version,
                    worker.lacks_chunks(generation_id),
                )
            )
            return {
                shard: [w.url for w in order if w.shard == shard and not w.silent]
                for shard in _shards_of(best)
            }

    def statuses(self) -> tuple[dict[Shard, SearchStatus], list[Shard]]:
        """What the furthest worker of each shard holds, and the shards without a worker."""
        with self._lock:
            best = self._best_workers(None)
            found: dict[Shard, SearchStatus] = {}
            for worker in sorted(best, key=_total_version):
                if worker.is_up and worker.shard is not None and worker.status is not None:
                    found[worker.shard] = worker.status
            return found, [shard for shard in _shards_of(best) if shard not in found]

    def _best_workers(self, generation_id: UUID | None) -> list[WorkerState]:
        """The workers of one number of shards."""
        numbers = {worker.shard.of for worker in self._workers if worker.shard}
        groups = {
            of: [worker for worker in self._workers if worker.shard and worker.shard.of == of]
            for of in numbers
        }

        def worth(of: int) -> tuple[float, float, int]:
            up = [worker for worker in groups[of] if worker.is_up]
            having = (
                up if generation_id is None else [w for w in up if w.version(generation_id) >= 0]
            )
            return _shard_coverage(having, of), _shard_coverage(up, of), of

        return groups[max(groups, key=worth)] if groups else []


def _shard_coverage(workers: Iterable[WorkerState], of: int) -> float:
    """The share of the shards that the workers hold."""
    return len({worker.shard for worker in workers}) / of


def _shards_of(workers: Sequence[WorkerState]) -> list[Shard]:
    """All shards of the number that the workers have in common, also those that no one serves."""
    of = next((worker.shard.of for worker in workers if worker.shard), 0)
    return [Shard(index, of) for index in range(of)]


def _total_version(worker: WorkerState) -> tuple[int, bool]:
    if worker.status is None:
        return 0, False
    return sum(worker.status.versions.values()), not worker.status.missing
