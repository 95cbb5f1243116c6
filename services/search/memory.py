"""Which parts of the generations are held in memory: what is read most, as far as the budget goes.

A generation's parts, in the order in which they are wanted: the levels of its sign codes, its int8
codes, its rows; whichever it has. A part is held whole or not at all; what is not held
stays a mapped file, of which the operating system keeps what it has room for.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from uuid import UUID


class Memory:
    """The budget, and who has what of it. Thread-safe."""

    def __init__(self, budget_bytes: int) -> None:
        self._budget_bytes = budget_bytes
        self._lock = threading.Lock()
        self._wanted: dict[UUID, Sequence[int]] = {}

    def parts_held(self, generation_id: UUID, part_bytes: Sequence[int]) -> int:
        """How many of the generation's parts, of these sizes, are to be held: the first so many."""
        with self._lock:
            self._wanted[generation_id] = part_bytes
            return held(self._wanted, self._budget_bytes)[generation_id]

    def forget(self, generation_id: UUID) -> None:
        with self._lock:
            self._wanted.pop(generation_id, None)


def held(wanted: Mapping[UUID, Sequence[int]], budget_bytes: int) -> dict[UUID, int]:
    """How many parts of each generation fit: everyone's first parts before anyone's second."""
    counts = dict.fromkeys(wanted, 0)
    left = budget_bytes
    for part in range(max(map(len, wanted.values()), default=0)):
        for generation_id, sizes in wanted.items():
            if counts[generation_id] == part < len(sizes) and sizes[part] <= left:
                left -= sizes[part]
                counts[generation_id] += 1
    return counts
