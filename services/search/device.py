"""Which snapshots lie on a GPU: as many as fit, the others are searched by the CPU.

Nothing here imports torch before a GPU is to be used.
"""

from __future__ import annotations

import importlib.util
import logging
import math
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID

from services.search.snapshot import Snapshot
from shared.errors import Misconfigured
from shared.search_protocol import DeviceStatus

if TYPE_CHECKING:
    from services.search.gpu import Device, Resident

log = logging.getLogger(__name__)

DRIVERS = (Path("/dev/nvidiactl"), Path("/dev/dxg"))  # Linux, and Linux on Windows
QUICK_BYTES = 1 << 28  # that a new snapshot may wait for: a tenth of a second
RETRY_SECONDS = 60.0


def open_device(wanted: str) -> Device | None:
    """The GPU for `SEARCH_DEVICE`, or None: search by the CPU.

    Misconfigured (`no_gpu`) when one is asked for and there is none that can be used.
    """
    torch_is_there = importlib.util.find_spec("torch") is not None
    if wanted == "cpu":
        return None
    if wanted == "auto" and not (torch_is_there and any(path.exists() for path in DRIVERS)):
        return None
    if not torch_is_there:
        raise _no_gpu("PyTorch is not installed: install placewise[search-gpu]")
    from services.search.gpu import Device, Unfit

    try:
        device = Device.cuda()
        reason = "PyTorch sees no CUDA device"
    except Unfit as error:
        device, reason = None, str(error)
    if device is None:
        if wanted == "cuda":
            raise _no_gpu(reason)
        log.warning("search uses the CPU: %s", reason)
    return device


def _no_gpu(reason: str) -> Misconfigured:
    return Misconfigured("no_gpu", f"SEARCH_DEVICE=cuda: {reason}. Or set SEARCH_DEVICE=cpu.")


class Residency:
    """What of a worker's snapshots lies on its device; one thread at a time for each generation."""

    def __init__(self, device: Device | None) -> None:
        self._device = device
        self._again: dict[UUID, float] = {}  # of time.monotonic(), after a failure
        self._failure: str | None = None

    def carry(self, new: Snapshot, old: Snapshot | None) -> Snapshot:
        """The new snapshot with what the old one has on the device, and little more."""
        resident = old.resident if old is not None else None
        if resident is not None:
            resident = self._load(new, resident, QUICK_BYTES)
        return replace(new, resident=resident)

    def wants(self, snapshot: Snapshot) -> bool:
        """Whether there is something to do: rows to put on the device, or to take from it."""
        if self._device is None or not snapshot.chunks:
            return False
        if snapshot.resident is not None:
            return snapshot.resident.failure is not None
        return time.monotonic() >= self._again.get(snapshot.generation_id, -math.inf)

    def fill(self, snapshot: Snapshot) -> Snapshot:
        """The snapshot with its rows on the device, if they fit; after a failure without them, and
        not again for a while.

        It may take minutes: nothing waits for it.
        """
        if snapshot.resident is not None:
            self._failure = snapshot.resident.failure
            resident = None
        else:
            resident = self._load(snapshot, None, math.inf)
        if resident is None:
            self._again[snapshot.generation_id] = time.monotonic() + RETRY_SECONDS
        return replace(snapshot, resident=resident)

    def lacks_int8(self, snapshot: Snapshot) -> bool:
        """Whether its int8 codes would fit, and are not made."""
        from services.search.gpu import FLOAT16, INT8

        if self._device is None or snapshot.bounded:
            return False
        return not self._device.has_room(snapshot.chunks, FLOAT16) and self._device.has_room(
            snapshot.chunks, INT8
        )

    def status(self, snapshots: Iterable[Snapshot]) -> tuple[DeviceStatus, ...]:
        if self._device is None:
            return ()
        there = {s.generation_id: s.resident for s in snapshots if s.resident is not None}
        failures = [one.failure for one in there.values() if one.failure is not None]
        return (
            DeviceStatus(
                name=self._device.name,
                resident_bytes=sum(one.nbytes for one in there.values()),
                generations={key: one.kind for key, one in there.items() if not one.failure},
                failure=failures[0] if failures else self._failure,
            ),
        )

    def _load(self, snapshot: Snapshot, old: Resident | None, most: float) -> Resident | None:
        from services.search.gpu import DeviceFailed

        if self._device is None or (old is not None and old.failure is not None):
            return None
        try:
            resident = self._device.load(snapshot.chunks, old, most)
        except DeviceFailed as error:
            log.error(
                "generation %s is searched by the CPU for now: %s", snapshot.generation_id, error
            )
            self._again[snapshot.generation_id] = time.monotonic() + RETRY_SECONDS
            self._failure = str(error)
            return None
        if resident is not None:
            self._failure = None
        return resident
