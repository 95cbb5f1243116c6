"""Directory of search workers and their shards, refreshed by polling their status.

`WorkerDirectory` polls every worker each second and orders the workers of each shard by how well
they can answer.
"""

from __future__ import annotations

import logging
import random
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from uuid import UUID

from shared.config.shards import Shard
from shared.errors import PlacewiseError
from shared.search_api.protocol import SearchStatus

log = logging.getLogger(__name__)


class WorkerUnavailable(Exception):
    """The worker did not answer, or its answer was not that of a search worker.

    Attributes:
        silent: The worker accepted the call and let it time out.
    """

    def __init__(self, url: str, reason: str, *, silent: bool = False) -> None:
        super().__init__(f"{url}: {reason}")
        self.silent = silent


REFRESH_SECONDS = 1.0  # polling interval


@dataclass(slots=True)
class _WorkerState:
    """Last known state of one worker; `status` is its last answer, however old."""

    url: str
    status: SearchStatus | None = None
    is_up: bool = False
    silent: bool = False
    """Its last status call timed out: a query to it would probably time out, too."""

    @property
    def shard(self) -> Shard | None:
        """The shard that the worker serves; None while it is unknown."""
        return None if self.status is None else Shard.parse(self.status.shard)

    def version(self, generation_id: UUID) -> int:
        """Loaded version of the generation at the last poll; -1 if it is not loaded."""
        return -1 if self.status is None else self.status.versions.get(generation_id, -1)

    def lacks_chunks(self, generation_id: UUID) -> bool:
        """Whether the worker lacks a chunk of the generation, which another replica may have."""
        return self.status is not None and generation_id in self.status.incomplete


class WorkerDirectory:
    """Polls and stores the status of the search workers at the given URLs. Thread-safe."""

    def __init__(self, urls: Sequence[str], fetch_status: Callable[[str], SearchStatus]) -> None:
        """`fetch_status` raises WorkerUnavailable for a URL without an answer."""
        self._fetch_status = fetch_status
        self._lock = threading.Lock()
        self._workers = [_WorkerState(url) for url in urls]
        self._status_executor = ThreadPoolExecutor(
            max(1, len(urls)), thread_name_prefix="search-status"
        )

    def close(self) -> None:
        """Stop the polling threads."""
        self._status_executor.shutdown()

    def refresh(self) -> None:
        """Poll all workers concurrently; takes as long as the slowest of them."""
        for _ in self._status_executor.map(self._refresh, self._workers):
            pass

    def _refresh(self, worker: _WorkerState) -> None:
        status, silent, reason = None, False, ""
        try:
            status = self._fetch_status(worker.url)
        except WorkerUnavailable as error:
            silent, reason = error.silent, str(error)
        except PlacewiseError as error:
            reason = error.detail
        with self._lock:
            known = worker.status is not None
            if worker.is_up and status is None:
                log.warning("a search worker is unreachable: %s", reason)
            elif known and not worker.is_up and status is not None:
                log.info("the search worker %s answers again: %s", worker.url, status.shard)
            worker.is_up, worker.silent = status is not None, silent
            worker.status = status or worker.status

    def mark_down(self, url: str) -> None:
        """Mark a worker as down until the next poll, so that others are preferred."""
        with self._lock:
            for worker in self._workers:
                if worker.url == url:
                    worker.is_up = False

    def layout(self, generation_id: UUID, min_version: int) -> dict[Shard, list[str]]:
        """Return every shard with its workers' URLs, best first; {} while no worker is known.

        While a deployment changes the number of shards, workers of different numbers run side by
        side. The number with the larger share of shards that have loaded the generation is used; of
        equals, the larger number.
        """
        with self._lock:
            best = self._best_workers(generation_id)
            order = random.sample(best, len(best))  # balances the load over replicas
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

    def urls(self) -> list[str]:
        """Return the URLs of all workers of any shard, best first."""
        with self._lock:
            workers = random.sample(self._workers, len(self._workers))
            workers.sort(key=lambda worker: (not worker.is_up, worker.silent))
            return [worker.url for worker in workers]

    def statuses(self) -> tuple[dict[Shard, SearchStatus], list[Shard]]:
        """Return the state of each shard's most advanced worker, and the shards without one."""
        with self._lock:
            best = self._best_workers(None)
            statuses: dict[Shard, SearchStatus] = {}
            for worker in sorted(best, key=_total_version):
                if worker.is_up and worker.shard is not None and worker.status is not None:
                    statuses[worker.shard] = worker.status
            return statuses, [shard for shard in _shards_of(best) if shard not in statuses]

    def _best_workers(self, generation_id: UUID | None) -> list[_WorkerState]:
        """The workers of the best number of shards."""
        shard_counts = {worker.shard.of for worker in self._workers if worker.shard}
        groups = {
            count: [worker for worker in self._workers if worker.shard and worker.shard.of == count]
            for count in shard_counts
        }

        def rank(count: int) -> tuple[float, float, int]:
            up = [worker for worker in groups[count] if worker.is_up]
            loaded = (
                up if generation_id is None else [w for w in up if w.version(generation_id) >= 0]
            )
            return _shard_coverage(loaded, count), _shard_coverage(up, count), count

        return groups[max(groups, key=rank)] if groups else []


def _shard_coverage(workers: Iterable[_WorkerState], count: int) -> float:
    """Share of the shards that the workers hold."""
    return len({worker.shard for worker in workers}) / count


def _shards_of(workers: Sequence[_WorkerState]) -> list[Shard]:
    """All shards of the workers' common number, including those that no worker serves."""
    count = next((worker.shard.of for worker in workers if worker.shard), 0)
    return [Shard(index, count) for index in range(count)]


def _total_version(worker: _WorkerState) -> tuple[int, bool]:
    if worker.status is None:
        return 0, False
    return sum(worker.status.versions.values()), not worker.status.missing
