"""GPU search: the cosines of all rows by products in float64, for generations that fit its memory.

Rows are held as they are stored. The products are summed in float64, so that the device's order of
summation changes a cosine by less than MARGIN: rows within it of the k-th one are compared again on
the CPU, and the results are the same as those of the CPU.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from uuid import UUID

import numpy as np
import torch
from numpy.typing import NDArray

from services.search.chunk_loader import LoadedChunk

MARGIN = 1e-9  # 2^-53 for each of 100,000 products, of the device and of the CPU
CONVERTED_NUMBERS = 1 << 26  # numbers of rows that are float64 at a time: 512 MB
HEADROOM_BYTES = 1 << 30  # device memory that is left for these and for the cosines


class GpuError(Exception):
    """The GPU failed, for example because its memory is full."""


class GpuDevice:
    """A GPU, with its memory."""

    def __init__(self, torch_device: torch.device) -> None:
        self._torch_device = torch_device

    @classmethod
    def cuda(cls) -> GpuDevice | None:
        """Return the first CUDA device; None if there is none."""
        return cls(torch.device("cuda", 0)) if torch.cuda.is_available() else None

    @property
    def name(self) -> str:
        """The device, as PyTorch and its driver name it."""
        if self._torch_device.type == "cuda":
            return f"{self._torch_device} {torch.cuda.get_device_name(self._torch_device)}"
        return str(self._torch_device)

    def free_bytes(self) -> float:
        """Return the memory that rows may take now."""
        if self._torch_device.type != "cuda":
            return float("inf")
        cached = torch.cuda.memory_reserved(self._torch_device)
        unused = cached - torch.cuda.memory_allocated(self._torch_device)
        return torch.cuda.mem_get_info(self._torch_device)[0] + unused - HEADROOM_BYTES

    def load(
        self, chunks: Sequence[LoadedChunk], old: GpuSnapshot | None, max_bytes: float
    ) -> GpuSnapshot | None:
        """Load a snapshot's rows into GPU memory, reusing those of the previous one, if any.

        Returns:
            The rows; None if they don't fit, or more than `max_bytes` would have to be copied.

        Raises:
            GpuError: The copy failed.
        """
        reusable = {} if old is None else old.rows
        new = [chunk for chunk in chunks if chunk.chunk_id not in reusable]
        if sum(chunk.rows.nbytes for chunk in new) > min(max_bytes, self.free_bytes()):
            return None
        try:
            copied = {c.chunk_id: torch.tensor(c.rows, device=self._torch_device) for c in new}
        except RuntimeError as error:  # includes out-of-memory errors
            raise GpuError(str(error)) from error
        known = {**reusable, **copied}
        return GpuSnapshot(self._torch_device, {c.chunk_id: known[c.chunk_id] for c in chunks})


class GpuSnapshot:
    """A snapshot's rows in GPU memory; immutable. The memory is freed with its last reference."""

    def __init__(self, torch_device: torch.device, rows: Mapping[UUID, torch.Tensor]) -> None:
        self._torch_device = torch_device
        self.rows = rows
        """Chunk id -> (rows, dimension), in the snapshot's order."""
        self.failure: str | None = None
        """Error after which it must not be used any more; None while it works."""

    @property
    def nbytes(self) -> int:
        """Bytes of GPU memory."""
        return sum(rows.nbytes for rows in self.rows.values())

    def find_candidates(
        self,
        query: NDArray[np.float32],
        row_mask: NDArray[np.bool_],
        k: int,
        min_score: float | None,
    ) -> NDArray[np.int64]:
        """Find the rows that may be among the `k` best of at least `min_score`.

        Args:
            query: (dimension,) row of any length but 0.
            row_mask: (n,) bool, the rows that may be returned.
            k: Number of results.
            min_score: Minimum cosine, if any.

        Raises:
            GpuError: The GPU failed; `failure` is set.
        """
        try:
            cosines = self._cosines(query)
            cosines[torch.tensor(~row_mask, device=self._torch_device)] = -torch.inf
            floor = float(torch.topk(cosines, min(k, len(cosines))).values[-1])
            # Answers have no score above 1, which a float16 row may exceed: such rows are equal.
            floor = min(1.0, floor if min_score is None else max(floor, min_score)) - MARGIN
            found = (cosines >= floor) & (cosines > -torch.inf)
            return torch.nonzero(found)[:, 0].cpu().numpy()
        except RuntimeError as error:
            self.failure = str(error)
            raise GpuError(self.failure) from error

    def _cosines(self, query: NDArray[np.float32]) -> torch.Tensor:
        unit = torch.tensor(query, dtype=torch.float64, device=self._torch_device)
        unit /= unit.norm()
        batch = max(1, CONVERTED_NUMBERS // len(unit))
        return torch.cat(
            [b.double() @ unit for r in self.rows.values() for b in torch.split(r, batch)]
        )
