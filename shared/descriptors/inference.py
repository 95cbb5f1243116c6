"""How much goes through a network at once, and what happens when that is more than the GPU holds.

A pass for which memory does not suffice is repeated with half of its photos, and from then on none
is larger. What one photo needs grows with its pixels, so it is pixels that are counted.

In which numbers a network computes: `float32`, or `bfloat16` where that loses little.

bfloat16 is autocast: weights, the sums along the residual path, normalisations and everything after
the backbone stay float32; products of matrices and convolutions are taken in bfloat16. It has
float32's range, so that what fits into one fits into the other, and 8 bits of precision.

float32 means just that. PyTorch would let convolutions on a GPU round their inputs to TF32, with 11
bits of precision; here nothing does.

How full the GPUs of this process are.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch

from shared.errors import Unprocessable
from shared.extractor_config.configs import ExtractorConfig
from shared.imaging.preprocessing import Pixels

log = logging.getLogger(__name__)

DEFAULT_PHOTO_PIXELS = 224 * 224  # of a photo, by which the size of a pass is chosen

# All threads of a process queue their work on one GPU in one line: side by side they would gain
# nothing, and need memory for both.
_gpu_lock = threading.Lock()


class PhotoTooLargeForGpu(Unprocessable):
    """One photo alone is too much for the GPU: code `gpu_out_of_memory`."""

    place = 0
    """Which of the photos that were to be described, counted from 0."""

    @classmethod
    def for_photo(cls, place: int, height: int, width: int) -> PhotoTooLargeForGpu:
        error = cls(
            "gpu_out_of_memory",
            "The GPU's memory does not suffice for this photo alone, of which the preprocessing "
            f"makes {width} x {height} pixels. See what else uses the GPU (`nvidia-smi`) and retry "
            "the job; or take a preprocessing that makes photos smaller (square224), a smaller "
            "extractor, or DEVICE=cpu.",
        )
        error.place = place
        return error


class BatchSizeLimit:
    """What one loaded network can take at once. Kept as long as the process lives."""

    def __init__(self) -> None:
        self._most_pixels: float = math.inf

    def photos(self, batch: int, photo_pixels: int) -> int:
        """How many photos of that size make one pass of a batch of `batch` photos: together no more
        pixels than the batch would have at 224 x 224, or else one photo.
        """
        return max(1, int(min(batch * DEFAULT_PHOTO_PIXELS, self._most_pixels)) // photo_pixels)

    def record_out_of_memory(self, photos: int, photo_pixels: int) -> None:
        """A pass of several such photos did not fit: the next ones have half of it at most."""
        self._most_pixels = min(self._most_pixels, photos * photo_pixels // 2)
        log.warning(
            "%d photos of %d pixels at once are too much for the GPU: half of that from now on",
            photos,
            photo_pixels,
        )


def run_in_batches(
    photos: Collection[Pixels],
    run: Callable[[Pixels], torch.Tensor],
    limit: BatchSizeLimit,
    device: torch.device,
) -> Iterator[tuple[list[int], torch.Tensor]]:
    """Pass by pass: the places of its photos in `photos`, and what `run` makes of them.

    `run` takes (B, H, W, 3): photos of one size, as many as `limit` says. On a GPU it has to leave
    nothing of its own there but what it returns. Raises PhotoDoesNotFit.
    """
    listed = list(photos)
    of_shape: dict[tuple[int, ...], list[int]] = {}
    for place, photo in enumerate(listed):
        of_shape.setdefault(photo.shape, []).append(place)
    for (height, width, _), left in of_shape.items():
        while left:
            chosen = left[: limit.photos(len(listed), height * width)]
            found = _run_unless_out_of_memory(
                run, np.stack([listed[place] for place in chosen]), device
            )
            if found is not None:
                left = left[len(chosen) :]
                yield chosen, found
            elif len(chosen) > 1:
                limit.record_out_of_memory(len(chosen), height * width)
            else:
                raise PhotoTooLargeForGpu.for_photo(chosen[0], height, width)


def _run_unless_out_of_memory(
    run: Callable[[Pixels], torch.Tensor], pixels: Pixels, device: torch.device
) -> torch.Tensor | None:
    """None where the GPU has no memory for it."""
    with _gpu_lock if device.type == "cuda" else contextlib.nullcontext():
        try:
            return run(pixels)
        except torch.cuda.OutOfMemoryError:
            pass
        # Outside of the handler, which would still hold what the pass had come to.
        torch.cuda.empty_cache()
        return None


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
