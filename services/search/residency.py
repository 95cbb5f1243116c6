"""Residency: which index parts are held in memory.

`MemoryBudget` allocates memory to the parts of all generations, in the order in which they are read
most: the levels of the sign codes, then the rows. A part is resident completely or stays a mapped
file in the system's page cache.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from uuid import UUID


class MemoryBudget:
    """Memory budget shared by the generations of a worker; thread-safe."""

    def __init__(self, budget_bytes: int) -> None:
        self._budget_bytes = budget_bytes
        self._lock = threading.Lock()
        self._requests: dict[UUID, Sequence[int]] = {}

    def allocate(self, generation_id: UUID, part_bytes: Sequence[int]) -> int:
        """Return how many of the generation's first parts, of these sizes, are to be resident."""
        with self._lock:
            self._requests[generation_id] = part_bytes
            return allocate_parts(self._requests, self._budget_bytes)[generation_id]

    def release_generation(self, generation_id: UUID) -> None:
        """Release the memory of a generation."""
        with self._lock:
            self._requests.pop(generation_id, None)


def allocate_parts(requests: Mapping[UUID, Sequence[int]], budget_bytes: int) -> dict[UUID, int]:
    """Return how many parts of each generation fit: all first parts before any second part."""
    counts = dict.fromkeys(requests, 0)
    remaining = budget_bytes
    for part in range(max(map(len, requests.values()), default=0)):
        for generation_id, sizes in requests.items():
            if counts[generation_id] == part < len(sizes) and sizes[part] <= remaining:
                remaining -= sizes[part]
                counts[generation_id] += 1
    return counts
