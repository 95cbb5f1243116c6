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
    from services.search.cascade import Blocks, CodedQuery, Glance

MOST_TOGETHER = 32


@dataclass(slots=True, eq=False)
class _Waiting:
    blocks: Blocks
    query: CodedQuery
    asked: NDArray[np.bool_]
    turn: threading.Event = field(default_factory=threading.Event)
    """Set when there is an answer, or when it is this one's turn to go for all."""
    found: Glance | None = None
    error: BaseException | None = None


class Glances:
    """`glance` for one query at a time, from many threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: list[_Waiting] = []
        self._on_the_way = False
        self.rounds = 0  # begun so far
        self.queries = 0  # that went with them

    @property
    def waiting(self) -> int:
        """How many queries wait for the round that is on its way."""
        return len(self._waiting)

    def glance(self, blocks: Blocks, query: CodedQuery, asked: NDArray[np.bool_]) -> Glance:
        mine = _Waiting(blocks, query, asked)
        with self._lock:
            self._waiting.append(mine)
            if not self._on_the_way:
                self._on_the_way = True
                mine.turn.set()
        mine.turn.wait()
        if mine.found is None and mine.error is None:
            self._go(mine)
        if mine.error is not None:
            raise mine.error
        assert mine.found is not None
        return mine.found

    def _go(self, leader: _Waiting) -> None:
        """One round for all who wait for the same blocks; then it is the next one's turn."""
        from services.search.cascade import glance

        with self._lock:
            others = [w for w in self._waiting if w.blocks is leader.blocks and w is not leader]
            together = [leader, *others[: MOST_TOGETHER - 1]]
            self._waiting = [w for w in self._waiting if w not in together]
            self.rounds += 1
            self.queries += len(together)
        try:
            found = glance(leader.blocks, [w.query for w in together], [w.asked for w in together])
            for one, glanced in zip(together, found, strict=True):
                one.found = glanced
        except BaseException as error:
            for one in together:
                one.error = error
            if not isinstance(error, Exception):
                raise
        finally:
            with self._lock:
                if self._waiting:
                    self._waiting[0].turn.set()
                else:
                    self._on_the_way = False
            for one in together:
                one.turn.set()
