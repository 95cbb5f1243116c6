"""In which numbers a network computes: `float32`, or `bfloat16` where that loses little.

bfloat16 is autocast: weights, the sums along the residual path, normalisations and everything after
the backbone stay float32; products of matrices and convolutions are taken in bfloat16. It has
float32's range, so that what fits into one fits into the other, and 8 bits of precision.

float32 means just that. PyTorch would let convolutions on a GPU round their inputs to TF32, with 11
bits of precision; here nothing does.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Literal, get_args

import torch

from shared.recipes import ExtractorConfig

Precision = Literal["float32", "bfloat16"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)


def choose_precision(
    requested: Literal["auto", "float32", "bfloat16"], recipe: ExtractorConfig, device: torch.device
) -> Precision:
    """What a new generation is made in; `requested` is PRECISION.

    `auto` is bfloat16 for DINOv2 on CUDA, and float32 for all else: EfficientNet-Lite0, which takes
    no time anyway, sums in bfloat16 from block to block and loses too much by it
    (`benchmarks/RESULTS.md`), and of torch.hub entries nobody has tried it.
    """
    if requested != "auto":
        return requested
    return "bfloat16" if device.type == "cuda" and recipe.depth is not None else "float32"


@contextlib.contextmanager
def autocast(precision: Precision, device: torch.device) -> Iterator[None]:
    """What the block computes on `device` is computed in `precision`."""
    # For the whole process, and each time: code from torch.hub may have said otherwise meanwhile.
    torch.backends.cudnn.allow_tf32 = False
    torch.set_float32_matmul_precision("highest")
    if precision == "float32":
        yield
        return
    with torch.autocast(device.type, torch.bfloat16):
        yield
