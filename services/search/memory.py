"""Which parts of the generations are held in memory: what is read most, as far as the budget goes.

A generation's parts, in the order in which they are wanted: the levels of its sign codes, its int8
codes, its rows; whichever it has. A part is held whole or not at all; what is not held
stays a mapped file, of which the operating system keeps what it has room for.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from uuid import UUID


class MemoryBudget:
    """The budget, and who has what of it. Thread-safe."""

    def __init__(self, budget_bytes: int) -> None:
        self._budget_bytes = budget_bytes
        self._lock = threading.Lock()
        self._requests: dict[UUID, Sequence[int]] = {}

    def allocate(self, generation_id: UUID, part_bytes: Sequence[int]) -> int:
        """How many of the generation's parts, of these sizes, are to be held: the first so many."""
        with self._lock:
            self._requests[generation_id] = part_bytes
            return allocate_parts(self._requests, self._budget_bytes)[generation_id]

    def release_generation(self, generation_id: UUID) -> None:
        with self._lock:
            self._requests.pop(generation_id, None)


def allocate_parts(requests: Mapping[UUID, Sequence[int]], budget_bytes: int) -> dict[UUID, int]:
    """How many parts of each generation fit: everyone's first parts before anyone's second."""
    counts = dict.fromkeys(requests, 0)
    left = budget_bytes
    for part in range(max(map(len, requests.values()), default=0)):
        for generation_id, sizes in requests.items():
            if counts[generation_id] == part < len(sizes) and sizes[part] <= left:
                left -= sizes[part]
                counts[generation_id] += 1
    return counts
