"""GPU search: the cosines of all rows by products in float64, for generations that fit its memory.

Rows are held as they are stored. The products are summed in float64, so that the device's order of
summation changes a cosine by less than MARGIN: rows within it of the k-th one are compared again on
the CPU, and the results are the same as those of the CPU.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable
from uuid import UUID

import numpy as np
import torch
from numpy.typing import NDArray

from services.search.snapshot import Snapshot
from shared.search_api.protocol import DeviceStatus

log = logging.getLogger(__name__)

MARGIN = 1e-9  # 2^-53 for each of 100,000 products, of the device and of the CPU
CONVERTED_NUMBERS = 1 << 26  # numbers of rows that are float64 at a time: 512 MB
HEADROOM_BYTES = 1 << 30  # device memory that is left for these and for the cosines
RETRY_SECONDS = 60.0  # after rows that did not fit, or a failure


class GpuRows:
    """The rows of generations in a GPU's memory; queries use them from any thread."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._rows: dict[UUID, dict[UUID, torch.Tensor]] = {}  # of each chunk of each generation
        self._retry_at: dict[UUID, float] = {}
        self._failure: str | None = None

    @classmethod
    def on_cuda(cls) -> GpuRows | None:
        """Use the first CUDA device; None if there is none."""
        return cls(torch.device("cuda", 0)) if torch.cuda.is_available() else None

    def load(self, snapshot: Snapshot, max_bytes: float = math.inf) -> None:
        """Copy the rows of chunks that are not loaded, all or none, and drop those of others.

        Nothing is copied if it is more than `max_bytes`, or if the snapshot has sign codes, which
        are faster on a CPU than all rows are on a GPU. Rows that don't fit, or fail to load, are
        tried again after RETRY_SECONDS.
        """
        key = snapshot.generation_id
        if snapshot.has_sign_codes:
            self.release([key])
            return
        old = self._rows.get(key, {})
        new = [chunk for chunk in snapshot.chunks if chunk.chunk_id not in old]
        size_bytes = sum(chunk.rows.nbytes for chunk in new)
        is_current = not new and len(old) == len(snapshot.chunks)
        if is_current or size_bytes > max_bytes or time.monotonic() < self._retry_at.get(key, 0.0):
            return
        if size_bytes > self.free_bytes():
            self._drop(key)
            return
        try:
            copied = {c.chunk_id: torch.tensor(c.rows, device=self._device) for c in new}
        except RuntimeError as error:  # includes out-of-memory errors
            self._drop(key, error)
            return
        known = {**old, **copied}
        self._rows[key] = {c.chunk_id: known[c.chunk_id] for c in snapshot.chunks}
        self._failure = None

    def release(self, generation_ids: Iterable[UUID]) -> None:
        """Free the memory of generations, after their last query."""
        for key in generation_ids:
            self._rows.pop(key, None)
            self._retry_at.pop(key, None)

    def find_candidates(
        self,
        snapshot: Snapshot,
        query: NDArray[np.float32],
        row_mask: NDArray[np.bool_],
        k: int,
        min_score: float | None,
    ) -> NDArray[np.int64] | None:
        """Find the rows that may be among the `k` best of at least `min_score`.

        Arguments as of `dense_scan.scan_top_k`. Returns None if rows are not loaded, or the GPU
        fails.
        """
        loaded = self._rows.get(snapshot.generation_id, {})
        if not all(chunk.chunk_id in loaded for chunk in snapshot.chunks):
            return None
        try:
            cosines = self._cosines([loaded[c.chunk_id] for c in snapshot.chunks], query)
            cosines[torch.tensor(~row_mask, device=self._device)] = -torch.inf
            floor = float(torch.topk(cosines, min(k, len(cosines))).values[-1])
            # Answers have no score above 1, which a float16 row may exceed: such rows are equal.
            floor = min(1.0, floor if min_score is None else max(floor, min_score)) - MARGIN
            found = (cosines >= floor) & (cosines > -torch.inf)
            return torch.nonzero(found)[:, 0].cpu().numpy()
        except RuntimeError as error:
            self._drop(snapshot.generation_id, error)
            return None

    def status(self) -> DeviceStatus:
        """Return what is loaded, and the last failure."""
        loaded = dict(self._rows)
        return DeviceStatus(
            name=self._name(),
            resident_bytes=sum(t.nbytes for rows in loaded.values() for t in rows.values()),
            generations=tuple(loaded),
            failure=self._failure,
        )

    def free_bytes(self) -> float:
        """Return the memory that rows may take now."""
        if self._device.type != "cuda":
            return math.inf
        cached = torch.cuda.memory_reserved(self._device)
        unused = cached - torch.cuda.memory_allocated(self._device)
        return torch.cuda.mem_get_info(self._device)[0] + unused - HEADROOM_BYTES

    def _name(self) -> str:
        if self._device.type != "cuda":
            return str(self._device)
        return f"{self._device} {torch.cuda.get_device_name(self._device)}"

    def _drop(self, key: UUID, error: Exception | None = None) -> None:
        self._rows.pop(key, None)
        self._retry_at[key] = time.monotonic() + RETRY_SECONDS
        if error is not None:
            self._failure = str(error)
            log.error("generation %s is searched by the CPU for now: %s", key, error)

    def _cosines(self, chunks: list[torch.Tensor], query: NDArray[np.float32]) -> torch.Tensor:
        unit = torch.tensor(query, dtype=torch.float64, device=self._device)
        unit /= unit.norm()
        batch = max(1, CONVERTED_NUMBERS // len(unit))
        return torch.cat([b.double() @ unit for r in chunks for b in torch.split(r, batch)])
