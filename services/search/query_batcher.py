"""Queries that come at the same time go through the first codes together.

Who comes first goes at once, alone; who comes meanwhile waits, and all who wait go next. So no one
waits longer than for the round that is on its way, and many cost little more than one.
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
    asked: NDArray[np.bool_]
    ready: threading.Event = field(default_factory=threading.Event)
    """Set when there is an answer, or when it is this one's turn to go for all."""
    found: FirstLevelScan | None = None
    error: BaseException | None = None


class QueryBatcher:
    """`glance` for one query at a time, from many threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._queue: list[_QueuedQuery] = []
        self._batch_running = False
        self.batches_run = 0  # begun so far
        self.queries_run = 0  # that went with them

    @property
    def queue_length(self) -> int:
        """How many queries wait for the round that is on its way."""
        return len(self._queue)

    def scan(
        self, blocks: SignCodeBlocks, query: SignCodedQuery, asked: NDArray[np.bool_]
    ) -> FirstLevelScan:
        mine = _QueuedQuery(blocks, query, asked)
        with self._lock:
            self._queue.append(mine)
            if not self._batch_running:
                self._batch_running = True
                mine.ready.set()
        mine.ready.wait()
        if mine.found is None and mine.error is None:
            self._run_batch(mine)
        if mine.error is not None:
            raise mine.error
        assert mine.found is not None
        return mine.found

    def _run_batch(self, leader: _QueuedQuery) -> None:
        """One round for all who wait for the same blocks; then it is the next one's turn."""
        from services.search.sign_code_search import scan_first_level

        with self._lock:
            others = [w for w in self._queue if w.blocks is leader.blocks and w is not leader]
            together = [leader, *others[: MAX_BATCH_QUERIES - 1]]
            self._queue = [w for w in self._queue if w not in together]
            self.batches_run += 1
            self.queries_run += len(together)
        try:
            found = scan_first_level(
                leader.blocks, [w.query for w in together], [w.asked for w in together]
            )
            for one, glanced in zip(together, found, strict=True):
                one.found = glanced
        except BaseException as error:
            for one in together:
                one.error = error
            if not isinstance(error, Exception):
                raise
        finally:
            with self._lock:
                if self._queue:
                    self._queue[0].ready.set()
                else:
                    self._batch_running = False
            for one in together:
                one.ready.set()
