"""Directory of search workers, refreshed by polling their status.

`WorkerDirectory` polls every worker each second and orders them by how well they can answer.
"""

from __future__ import annotations

import logging
import random
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from uuid import UUID

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
                log.info("the search worker %s answers again", worker.url)
            worker.is_up, worker.silent = status is not None, silent
            worker.status = status or worker.status

    def mark_down(self, url: str) -> None:
        """Mark a worker as down until the next poll, so that others are preferred."""
        with self._lock:
            for worker in self._workers:
                if worker.url == url:
                    worker.is_up = False

    def urls(self, generation_id: UUID | None = None, min_version: int = 0) -> list[str]:
        """Return the URLs of the workers, best first.

        Those that have loaded the generation come before those that have not.
        """
        with self._lock:
            workers = random.sample(self._workers, len(self._workers))  # balances the load
            workers.sort(
                key=lambda worker: (
                    worker.silent,
                    not worker.is_up,
                    generation_id is not None
                    and (
                        worker.version(generation_id) < min_version,
                        worker.lacks_chunks(generation_id),
                    ),
                )
            )
            # A query to a silent worker would wait for nothing.
            return [w.url for w in workers if generation_id is None or not w.silent]

    def best_status(self) -> SearchStatus | None:
        """Return the state of the most advanced worker that answers; None if none does."""
        with self._lock:
            found = [worker.status for worker in self._workers if worker.is_up and worker.status]
        return max(found, key=lambda s: (sum(s.versions.values()), not s.missing), default=None)
