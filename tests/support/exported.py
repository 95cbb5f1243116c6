"""TorchScript and ONNX files of a tiny network: descriptors or patches of photos of 64 x 64."""

from __future__ import annotations

import hashlib
import io
import warnings
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from onnx import TensorProto, helper
from onnx.numpy_helper import from_array

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


def onnx_file(
    nodes: list[Any],
    constants: Sequence[Any] = (),
    kind: int = TensorProto.FLOAT,
    shape: tuple[Any, ...] = ("batch", 3, SIDE, SIDE),
) -> bytes:
    """An ONNX file of operators from `x` to `y`."""
    out = TensorProto.FLOAT if kind == TensorProto.UINT8 else kind
    graph = helper.make_graph(
        nodes,
        "graph",
        [helper.make_tensor_value_info("x", kind, shape)],
        [helper.make_tensor_value_info("y", out, None)],
        constants,
    )
    opset = helper.make_opsetid("", 17)
    data: bytes = helper.make_model(graph, opset_imports=[opset], ir_version=9).SerializeToString()
    return data


@cache
def tiny_onnx(*, patches: bool = False, batch: int | str = "batch", half: bool = False) -> bytes:
    """The tiny network written by hand, in milliseconds: torch.onnx takes seconds."""
    network = tiny_network(patches=patches)
    if patches:
        weights = network.convolution.weight
        nodes = [helper.make_node("Conv", ["x", "w"], ["y"], strides=[16, 16])]
    else:
        weights = network.projection
        nodes = [
            helper.make_node("AveragePool", ["x"], ["a"], kernel_shape=[8, 8], strides=[8, 8]),
            helper.make_node("Flatten", ["a"], ["f"]),
            helper.make_node("MatMul", ["f", "w"], ["y"]),
        ]
    constant = from_array((weights.half() if half else weights).numpy(), "w")
    kind = TensorProto.FLOAT16 if half else TensorProto.FLOAT
    return onnx_file(nodes, [constant], kind, (batch, 3, SIDE, SIDE))


@cache
def tiny_torchscript(*, patches: bool = False, seed: int = 7) -> bytes:
    return torchscript_of(tiny_network(patches=patches, seed=seed))


def code_name(data: bytes) -> str:
    """What CODE_ALLOWED holds for a TorchScript file."""
    return f"torchscript:{hashlib.sha256(data).hexdigest()}"
