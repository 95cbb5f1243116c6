"""How full the GPUs of this process are."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True, slots=True)
class GpuMemory:
    name: str
    """`cuda:0`"""
    used_bytes: int
    """Held by this process's PyTorch, its own reserve included."""
    total_bytes: int


def gpu_memory() -> list[GpuMemory]:
    """Of each GPU that this process has begun to use: none on a CPU."""
    if not torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        return []
    return [
        GpuMemory(
            f"cuda:{number}",
            torch.cuda.memory_reserved(number),
            torch.cuda.get_device_properties(number).total_memory,
        )
        for number in range(torch.cuda.device_count())
    ]
