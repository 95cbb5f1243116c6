"""Which snapshots lie on a GPU: as many as fit, the others are searched by the CPU.

Nothing here imports torch before a GPU is to be used.

Which parts of the generations are held in memory: what is read most, as far as the budget goes.

A generation's parts, in the order in which they are wanted: the levels of its sign codes, its int8
codes, its rows; whichever it has. A part is held whole or not at all; what is not held
stays a mapped file, of which the operating system keeps what it has room for.
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
MAX_SYNC_COPY_BYTES = 1 << 28  # that a new snapshot may wait for: a tenth of a second
GPU_RETRY_SECONDS = 60.0


def open_search_device(setting: str) -> GpuDevice | None:
    """The GPU for `SEARCH_DEVICE`, or None: search by the CPU.

    Misconfigured (`no_gpu`) when one is asked for and there is none that can be used.
    """
    torch_is_there = importlib.util.find_spec("torch") is not None
    if setting == "cpu":
        return None
    if setting == "auto" and not (torch_is_there and any(path.exists() for path in DRIVER_PATHS)):
        return None
    if not torch_is_there:
        raise _no_gpu_error("PyTorch is not installed: install placewise[search-gpu]")
    from services.search.gpu import GpuDevice, GpuUnsupported

    try:
        device = GpuDevice.cuda()
        reason = "PyTorch sees no CUDA device"
    except GpuUnsupported as error:
        device, reason = None, str(error)
    if device is None:
        if setting == "cuda":
            raise _no_gpu_error(reason)
        log.warning("search uses the CPU: %s", reason)
    return device


def _no_gpu_error(reason: str) -> Misconfigured:
    return Misconfigured("no_gpu", f"SEARCH_DEVICE=cuda: {reason}. Or set SEARCH_DEVICE=cpu.")


class GpuResidency:
    """What of a worker's snapshots lies on its device; one thread at a time for each generation."""

    def __init__(self, device: GpuDevice | None) -> None:
        self._device = device
        self._retry_at: dict[UUID, float] = {}  # of time.monotonic(), after a failure
        self._failure: str | None = None

    def carry_over(self, new: Snapshot, old: Snapshot | None) -> Snapshot:
        """The new snapshot with what the old one has on the device, and little more."""
        resident = old.gpu_snapshot if old is not None else None
        if resident is not None:
            resident = self._load(new, resident, MAX_SYNC_COPY_BYTES)
        return replace(new, gpu_snapshot=resident)

    def needs_update(self, snapshot: Snapshot) -> bool:
        """Whether there is something to do: rows to put on the device, or to take from it."""
        if self._device is None or not snapshot.chunks:
            return False
        if snapshot.gpu_snapshot is not None:
            return snapshot.gpu_snapshot.failure is not None
        return time.monotonic() >= self._retry_at.get(snapshot.generation_id, -math.inf)

    def update(self, snapshot: Snapshot) -> Snapshot:
        """The snapshot with its rows on the device, if they fit; after a failure without them, and
        not again for a while.

        It may take minutes: nothing waits for it.
        """
        if snapshot.gpu_snapshot is not None:
            self._failure = snapshot.gpu_snapshot.failure
            resident = None
        else:
            resident = self._load(snapshot, None, math.inf)
        if resident is None:
            self._retry_at[snapshot.generation_id] = time.monotonic() + GPU_RETRY_SECONDS
        return replace(snapshot, gpu_snapshot=resident)

    def needs_int8_codes(self, snapshot: Snapshot) -> bool:
        """Whether its int8 codes would fit, and are not made."""
        from services.search.gpu import FLOAT16, INT8

        if self._device is None or snapshot.has_int8_codes:
            return False
        return not self._device.has_room(snapshot.chunks, FLOAT16) and self._device.has_room(
            snapshot.chunks, INT8
        )

    def status(self, snapshots: Iterable[Snapshot]) -> tuple[DeviceStatus, ...]:
        if self._device is None:
            return ()
        there = {s.generation_id: s.gpu_snapshot for s in snapshots if s.gpu_snapshot is not None}
        failures = [one.failure for one in there.values() if one.failure is not None]
        return (
            DeviceStatus(
                name=self._device.name,
                resident_bytes=sum(one.nbytes for one in there.values()),
                generations={key: one.row_format for key, one in there.items() if not one.failure},
                failure=failures[0] if failures else self._failure,
            ),
        )

    def _load(self, snapshot: Snapshot, old: GpuSnapshot | None, most: float) -> GpuSnapshot | None:
        from services.search.gpu import GpuError

        if self._device is None or (old is not None and old.failure is not None):
            return None
        try:
            resident = self._device.load(snapshot.chunks, old, most)
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
