"""What computes: the accelerator, its number and its precision, checked before anything is read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from services.trainer.arguments import TrainingArguments
from shared.errors import InvalidRequest, Misconfigured

PRECISION_ALIASES = {
    "32": "32-true",
    "32-true": "32-true",
    "16": "16-mixed",
    "16-mixed": "16-mixed",
    "bf16": "bf16-mixed",
    "bf16-mixed": "bf16-mixed",
}


@dataclass(frozen=True, slots=True)
class Device:
    accelerator: str
    """gpu, mps or cpu"""
    devices: Any
    """as Lightning wants it: [0] or 1"""
    precision: str
    torch_device: torch.device


def resolve_device(arguments: TrainingArguments) -> Device:
    """The one device that the arguments mean.

    Raises Misconfigured (`no_gpu`), InvalidRequest (`several_devices`, `unknown_precision`,
    `precision_unfit`).
    """
    accelerator = _resolve_accelerator(arguments.accelerator)
    index = _device_index(arguments.devices)
    precision = PRECISION_ALIASES.get(str(arguments.precision))
    if precision is None:
        raise InvalidRequest(
            "unknown_precision",
            f"--precision {arguments.precision} is unknown; known: {', '.join(PRECISION_ALIASES)}.",
        )
    if precision == "16-mixed" and accelerator != "gpu":
        raise InvalidRequest(
            "precision_unfit", "--precision 16-mixed needs a CUDA GPU; bf16-mixed and 32 do not."
        )
    if accelerator != "gpu":
        return Device(accelerator, 1, precision, torch.device(accelerator))
    if index >= torch.cuda.device_count():
        raise Misconfigured(
            "no_gpu",
            f"--devices [{index}]: this machine has {torch.cuda.device_count()} GPUs, "
            "numbered from 0.",
        )
    return Device("gpu", [index], precision, torch.device("cuda", index))


def _resolve_accelerator(requested: str) -> str:
    if requested == "auto":
        if torch.cuda.is_available():
            return "gpu"
        return "mps" if torch.backends.mps.is_available() else "cpu"
    if requested in ("gpu", "cuda"):
        if not torch.cuda.is_available():
            raise Misconfigured(
                "no_gpu",
                "PyTorch finds no CUDA GPU here (--accelerator gpu is the default). Train on the "
                "processor with --accelerator cpu --faiss_gpu False, or install the driver and a "
                "CUDA build of PyTorch.",
            )
        return "gpu"
    if requested == "mps" and not torch.backends.mps.is_available():
        raise Misconfigured("no_gpu", "PyTorch finds no MPS device here: say --accelerator cpu.")
    return requested


def _device_index(devices: int | str | tuple[int, ...]) -> int:
    if devices in (1, "1", "auto"):
        return 0
    if isinstance(devices, tuple) and len(devices) == 1 and devices[0] >= 0:
        return devices[0]
    raise InvalidRequest(
        "several_devices",
        f"--devices {devices}: a run has one device: 1, or its number as [0]. Runs of a grid can "
        "share a machine's GPUs, each with its own number.",
    )
