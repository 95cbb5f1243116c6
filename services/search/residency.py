"""Residency: which index parts are held in memory, and whether rows are loaded onto a GPU.

`MemoryBudget` allocates memory to the parts of all generations, in the order in which they are read
most: the levels of the sign codes, then the rows. A part is resident completely or stays a mapped
file in the system's page cache. torch is imported only when a GPU is to be used.
"""

from __future__ import annotations

import importlib.util
import logging
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID

from shared.errors import Misconfigured

if TYPE_CHECKING:
    from services.search.gpu import GpuRows


log = logging.getLogger(__name__)

DRIVER_PATHS = (Path("/dev/nvidiactl"), Path("/dev/dxg"))  # Linux, and Linux on Windows


def open_search_gpu(setting: str) -> GpuRows | None:
    """Open the first CUDA device if SEARCH_DEVICE selects it; None for the CPU.

    Raises:
        Misconfigured: `no_gpu` if `cuda` is selected and no GPU can be used.
    """
    has_torch = importlib.util.find_spec("torch") is not None
    if setting == "cpu":
        return None
    if setting == "auto" and not (has_torch and any(path.exists() for path in DRIVER_PATHS)):
        return None
    if not has_torch:
        raise _no_gpu_error("PyTorch is not installed: install placewise[search-gpu]")
    from services.search.gpu import GpuRows

    if (rows := GpuRows.on_cuda()) is not None:
        return rows
    reason = "PyTorch sees no CUDA device"
    if setting == "cuda":
        raise _no_gpu_error(reason)
    log.warning("search uses the CPU: %s", reason)
    return None


def _no_gpu_error(reason: str) -> Misconfigured:
    return Misconfigured("no_gpu", f"SEARCH_DEVICE=cuda: {reason}. Or set SEARCH_DEVICE=cpu.")


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
