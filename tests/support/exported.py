"""TorchScript and ONNX files of a tiny network: descriptors or patches of photos of 64 x 64."""

from __future__ import annotations

import hashlib
import io
import warnings
from functools import cache
from pathlib import Path

import torch

SIDE = 64  # pixels
DIMENSION, PATCH_WIDTH = 24, 6


class TinyNetwork(torch.nn.Module):
    """Descriptors are projections of a photo made small; patches are those of a convolution."""

    def __init__(self, *, patches: bool, seed: int = 7) -> None:
        super().__init__()
        rng = torch.Generator().manual_seed(seed)
        self.patches = patches
        weight = torch.randn(3 * (SIDE // 8) ** 2, DIMENSION, generator=rng)
        self.projection = torch.nn.Parameter(weight)
        self.convolution = torch.nn.Conv2d(3, PATCH_WIDTH, 16, stride=16, bias=False)
        self.convolution.weight.data = torch.randn(PATCH_WIDTH, 3, 16, 16, generator=rng)

    def forward(self, batch: torch.Tensor) -> torch.Tensor:
        if self.patches:
            out: torch.Tensor = self.convolution(batch)
            return out
        return torch.nn.functional.avg_pool2d(batch, 8).flatten(1) @ self.projection


@cache
def tiny_network(*, patches: bool = False, seed: int = 7) -> TinyNetwork:
    return TinyNetwork(patches=patches, seed=seed).eval().requires_grad_(False)


def torchscript_of(module: torch.nn.Module) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the format is deprecated, and files of it are published
        torch.jit.save(torch.jit.script(module), buffer)
    return buffer.getvalue()


def onnx_of(
    module: torch.nn.Module, folder: Path, *, external: bool = False, batch_size: int | None = None
) -> bytes:
    """With a batch of any size, or of `batch_size`."""
    path = folder / "net.onnx"
    batch = torch.rand(batch_size or 2, 3, SIDE, SIDE)
    shapes = None if batch_size else ({0: torch.export.Dim("batch")},)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            (batch,),
            path,
            dynamic_shapes=shapes,
            external_data=external,
            verbose=False,
            dynamo=True,
        )
    return path.read_bytes()


@cache
def tiny_torchscript(*, patches: bool = False, seed: int = 7) -> bytes:
    return torchscript_of(tiny_network(patches=patches, seed=seed))


def code_name(data: bytes) -> str:
    """What CODE_ALLOWED holds for a TorchScript file."""
    return f"torchscript:{hashlib.sha256(data).hexdigest()}"
