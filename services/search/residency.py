"""Residency: which index parts are held in memory, and which snapshots are loaded onto the GPU.

`MemoryBudget` allocates memory to the parts of all generations, in the order in which they are read
most: the levels of the sign codes, the int8 codes, the rows. A part is resident completely or stays
a mapped file in the system's page cache. `GpuResidency` loads as many snapshots as fit onto the
GPU; the others are searched on the CPU. torch is imported only when a GPU is to be used.
"""

from __future__ import annotations

import importlib.util
import logging
import math
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID

from services.search.snapshot import Snapshot
from shared.errors import Misconfigured
from shared.search_api.protocol import DeviceStatus

if TYPE_CHECKING:
    from services.search.gpu import GpuDevice, GpuSnapshot


log = logging.getLogger(__name__)

DRIVER_PATHS = (Path("/dev/nvidiactl"), Path("/dev/dxg"))  # Linux, and Linux on Windows
MAX_SYNC_COPY_BYTES = 1 << 28  # copied before a new snapshot is served: a tenth of a second
GPU_RETRY_SECONDS = 60.0


def open_search_device(setting: str) -> GpuDevice | None:
    """Open the GPU that SEARCH_DEVICE selects; None for the CPU.

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
    from services.search.gpu import GpuDevice

    device = GpuDevice.cuda()
    if device is not None:
        return device
    reason = "PyTorch sees no CUDA device"
    if setting == "cuda":
        raise _no_gpu_error(reason)
    log.warning("search uses the CPU: %s", reason)
    return None


def _no_gpu_error(reason: str) -> Misconfigured:
    return Misconfigured("no_gpu", f"SEARCH_DEVICE=cuda: {reason}. Or set SEARCH_DEVICE=cpu.")


class GpuResidency:
    """Loads snapshots onto the worker's GPU; one thread at a time for each generation."""

    def __init__(self, device: GpuDevice | None) -> None:
        self._device = device
        self._retry_at: dict[UUID, float] = {}  # of time.monotonic(), after a failure
        self._failure: str | None = None

    def carry_over(self, new: Snapshot, old: Snapshot | None) -> Snapshot:
        """Return the new snapshot with the GPU rows of the old one, if few must be copied."""
        resident = old.gpu_snapshot if old is not None else None
        if resident is not None:
            coded = new.has_sign_codes
            resident = None if coded else self._load(new, resident, MAX_SYNC_COPY_BYTES)
        return replace(new, gpu_snapshot=resident)

    def needs_update(self, snapshot: Snapshot) -> bool:
        """Whether the snapshot is to be loaded onto the GPU, or dropped after a failure."""
        if self._device is None or not snapshot.chunks or snapshot.has_sign_codes:
            return False  # sign codes are faster on a CPU than all rows are on a GPU
        if snapshot.gpu_snapshot is not None:
            return snapshot.gpu_snapshot.failure is not None
        return time.monotonic() >= self._retry_at.get(snapshot.generation_id, -math.inf)

    def update(self, snapshot: Snapshot) -> Snapshot:
        """Return the snapshot with its rows on the GPU, or without them after a failure.

        Rows that do not fit, or fail to load, are tried again after GPU_RETRY_SECONDS. Loading may
        take minutes: call it without holding a lock.
        """
        if snapshot.gpu_snapshot is not None:
            self._failure = snapshot.gpu_snapshot.failure
            resident = None
        else:
            resident = self._load(snapshot, None, math.inf)
        if resident is None:
            self._retry_at[snapshot.generation_id] = time.monotonic() + GPU_RETRY_SECONDS
        return replace(snapshot, gpu_snapshot=resident)

    def status(self, snapshots: Iterable[Snapshot]) -> tuple[DeviceStatus, ...]:
        """Return the state of the GPU, if there is one."""
        if self._device is None:
            return ()
        loaded = {s.generation_id: s.gpu_snapshot for s in snapshots if s.gpu_snapshot is not None}
        failures = [
            gpu_snapshot.failure
            for gpu_snapshot in loaded.values()
            if gpu_snapshot.failure is not None
        ]
        return (
            DeviceStatus(
                name=self._device.name,
                resident_bytes=sum(gpu_snapshot.nbytes for gpu_snapshot in loaded.values()),
                generations=tuple(key for key, there in loaded.items() if not there.failure),
                failure=failures[0] if failures else self._failure,
            ),
        )

    def _load(
        self, snapshot: Snapshot, old: GpuSnapshot | None, max_bytes: float
    ) -> GpuSnapshot | None:
        from services.search.gpu import GpuError

        if self._device is None or (old is not None and old.failure is not None):
            return None
        try:
            resident = self._device.load(snapshot.chunks, old, max_bytes)
        except GpuError as error:
            log.error(
                "generation %s is searched by the CPU for now: %s", snapshot.generation_id, error
            )
            self._retry_at[snapshot.generation_id] = time.monotonic() + GPU_RETRY_SECONDS
            self._failure = str(error)
            return None
        if resident is not None:
            self._failure = None
        return resident


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
