"""Query batcher: concurrent queries share one first-level scan of the sign codes.

The first query is scanned at once, alone; queries that arrive meanwhile are queued and scanned
together next. So a query waits for the running scan at most, and the scan of many queries costs
little more than that of one, because it is limited by memory bandwidth.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from services.search.sign_code_search import FirstLevelScan, SignCodeBlocks, SignCodedQuery

MAX_BATCH_QUERIES = 32


@dataclass(slots=True, eq=False)
class _QueuedQuery:
    blocks: SignCodeBlocks
    query: SignCodedQuery
    row_mask: NDArray[np.bool_]
    ready: threading.Event = field(default_factory=threading.Event)
    """Set when there is a result, or when this query's thread is to run the next batch."""
    scan: FirstLevelScan | None = None
    error: BaseException | None = None


class QueryBatcher:
    """Batches first-level scans of concurrent queries; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._queue: list[_QueuedQuery] = []
        self._batch_running = False
        self.batches_run = 0  # batches started so far
        self.queries_run = 0  # queries in these batches

    @property
    def queue_length(self) -> int:
        """Number of queries that wait for the running batch."""
        return len(self._queue)

    def scan(
        self, blocks: SignCodeBlocks, query: SignCodedQuery, row_mask: NDArray[np.bool_]
    ) -> FirstLevelScan:
        """Scan the first level of the codes for one query, together with concurrent queries."""
        queued = _QueuedQuery(blocks, query, row_mask)
        with self._lock:
            self._queue.append(queued)
            if not self._batch_running:
                self._batch_running = True
                queued.ready.set()
        queued.ready.wait()
        if queued.scan is None and queued.error is None:
            self._run_batch(queued)
        if queued.error is not None:
            raise queued.error
        assert queued.scan is not None
        return queued.scan

    def _run_batch(self, leader: _QueuedQuery) -> None:
        """Scan for the queued queries with the same blocks, then wake up the next leader."""
        from services.search.sign_code_search import scan_first_level

        with self._lock:
            others = [
                queued
                for queued in self._queue
                if queued.blocks is leader.blocks and queued is not leader
            ]
            batch = [leader, *others[: MAX_BATCH_QUERIES - 1]]
            self._queue = [queued for queued in self._queue if queued not in batch]
            self.batches_run += 1
            self.queries_run += len(batch)
        try:
            scans = scan_first_level(
                leader.blocks,
                [queued.query for queued in batch],
                [queued.row_mask for queued in batch],
            )
            for queued, scan in zip(batch, scans, strict=True):
                queued.scan = scan
        except BaseException as error:
            for queued in batch:
                queued.error = error
            if not isinstance(error, Exception):
                raise
        finally:
            with self._lock:
                if self._queue:
                    self._queue[0].ready.set()
                else:
                    self._batch_running = False
            for queued in batch:
                queued.ready.set()
