"""Who serves which shard: what the workers' own `/status` says, looked at about every second."""

from __future__ import annotations

import logging
import random
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from uuid import UUID

import httpx2

from shared.errors import PlacewiseError
from shared.search_http.worker_call import WorkerUnavailable, fetch_status
from shared.search_protocol import SearchStatus
from shared.shards import Shard

log = logging.getLogger(__name__)

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
