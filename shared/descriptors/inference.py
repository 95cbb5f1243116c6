"""Batched inference: batch size limits, out-of-memory recovery, precision, GPU memory.

Batch size: a forward pass that runs out of GPU memory is retried with half of its photos, and later
passes do not exceed that size. Memory grows with pixels, so the limit counts pixels, not photos.

Precision: `float32`, or `bfloat16` where that loses little accuracy. bfloat16 uses autocast:
residual sums, normalisations and everything after the backbone stay float32; matrix products and
convolutions run in bfloat16. It has float32's range, so that what fits into one fits
into the other, and 8 bits of precision. In float32, TF32 (11 bits of precision), which PyTorch
allows for convolutions by default, is disabled.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Literal, TypeVar, get_args

import numpy as np
import torch

from shared.errors import Misconfigured, Unprocessable
from shared.extractor_config.configs import ExtractorConfig
from shared.imaging.preprocessing import Pixels

log = logging.getLogger(__name__)

Result = TypeVar("Result")

DEFAULT_PHOTO_PIXELS = 224 * 224  # the pixels of one photo, for the default size of a batch
# A CPU's cache keeps the layers of so many pixels. With 16 photos of 256 x 448 pixels at once,
# EfficientNet-Lite0 took 2.4 times as long a photo on two cores, and ResNet-50 at 320 x 320 1.9.
CPU_PASS_PIXELS = 2 * DEFAULT_PHOTO_PIXELS

# Serializes GPU work across threads: concurrent passes would not be faster and would need the
# memory of both.
_gpu_lock = threading.Lock()


def inference_clock(device: torch.device) -> Callable[[], float]:
    """Return the clock of inference on a device, in seconds.

    On a CPU, the CPU time of the process: it does not grow with the load of other processes.
    """
    return time.process_time if device.type == "cpu" else time.perf_counter


class PhotoTooLargeForGpu(Unprocessable):
    """One photo alone exceeds the GPU's memory: code `gpu_out_of_memory`."""

    place = 0
    """Index of the photo in the input, from 0."""

    @classmethod
    def for_photo(cls, place: int, height: int, width: int) -> PhotoTooLargeForGpu:
        error = cls(
            "gpu_out_of_memory",
            f"The GPU ran out of memory for this photo alone ({width} x {height} pixels after "
            "preprocessing). Check what else uses the GPU (`nvidia-smi`) and retry the job; or "
            "use a preprocessing with smaller photos (square224), a smaller extractor, or "
            "DEVICE=cpu.",
        )
        error.place = place
        return error


@contextlib.contextmanager
def model_fits_gpu(name: str) -> Iterator[None]:
    """Raise Misconfigured (`gpu_out_of_memory`) if the block finds no memory for a model."""
    try:
        yield
    except (torch.cuda.OutOfMemoryError, PhotoTooLargeForGpu) as error:
        raise Misconfigured(
            "gpu_out_of_memory",
            f"The GPU's memory does not hold the weights of {name} and a single photo. Check what "
            "else uses the GPU (`nvidia-smi`), or configure a smaller extractor or DEVICE=cpu.",
        ) from error


class BatchSizeLimit:
    """The largest batch of one loaded network that fits the GPU, or the cache of a CPU.

    Lives as long as the process.
    """

    def __init__(self, device: torch.device) -> None:
        self._max_pixels: float = CPU_PASS_PIXELS if device.type == "cpu" else math.inf

    def photos(self, batch: int, photo_pixels: int) -> int:
        """Return how many photos of `photo_pixels` pixels to run in one pass, at least 1.

        Together they have no more pixels than `batch` photos of 224 x 224, and no more than the
        limit.
        """
        return max(1, int(min(batch * DEFAULT_PHOTO_PIXELS, self._max_pixels)) // photo_pixels)

    def record_out_of_memory(self, photos: int, photo_pixels: int) -> None:
        """Halve the limit after a pass of `photos` photos ran out of memory."""
        self._max_pixels = min(self._max_pixels, photos * photo_pixels // 2)
        log.warning(
            "%d photos of %d pixels at once are too much for the GPU; halving the batch size limit",
            photos,
            photo_pixels,
        )


def run_in_batches(
    photos: Collection[Pixels],
    run: Callable[[Pixels], Result],
    limit: BatchSizeLimit,
    device: torch.device,
) -> Iterator[tuple[list[int], Result]]:
    """Run `run` on batches of photos of the same size; halve the batch when memory runs out.

    Args:
        photos: (H, W, 3) pixels; sizes may differ.
        run: Takes a (B, H, W, 3) batch of photos of one size. On a GPU it must not leave anything
            allocated but its return value.
        limit: The batch size limit; lowered when a batch runs out of memory.

    Yields:
        The indices of the batch's photos in `photos`, and the result of `run`.

    Raises:
        PhotoTooLargeForGpu: One photo alone exceeds the GPU's memory.
    """
    photo_list = list(photos)
    by_shape: dict[tuple[int, ...], list[int]] = {}
    for index, photo in enumerate(photo_list):
        by_shape.setdefault(photo.shape, []).append(index)
    for (height, width, _), pending in by_shape.items():
        while pending:
            chosen = pending[: limit.photos(len(photo_list), height * width)]
            result = _run_unless_out_of_memory(
                run, np.stack([photo_list[index] for index in chosen]), device
            )
            if result is not None:
                pending = pending[len(chosen) :]
                yield chosen, result
            elif len(chosen) > 1:
                limit.record_out_of_memory(len(chosen), height * width)
            else:
                raise PhotoTooLargeForGpu.for_photo(chosen[0], height, width)


def _run_unless_out_of_memory(
    run: Callable[[Pixels], Result], pixels: Pixels, device: torch.device
) -> Result | None:
    """Return None if the GPU runs out of memory."""
    with _gpu_lock if device.type == "cuda" else contextlib.nullcontext():
        try:
            return run(pixels)
        except torch.cuda.OutOfMemoryError:
            pass
        # Outside of the handler, whose traceback would keep the tensors of the failed pass alive.
        torch.cuda.empty_cache()
        return None


Precision = Literal["float32", "bfloat16"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)


def choose_precision(
    requested: Literal["auto", "float32", "bfloat16"], config: ExtractorConfig, device: torch.device
) -> Precision:
    """Return the precision of a new generation; `requested` is the setting PRECISION.

    `auto` is bfloat16 for DINOv2 on CUDA, else float32: EfficientNet-Lite0 is fast anyway, and in
    bfloat16 its sums from block to block lose too much accuracy (`lab/benchmarks/RESULTS.md`);
    bfloat16 is not measured for torch.hub entries.
    """
    if requested != "auto":
        return requested
    return "bfloat16" if device.type == "cuda" and config.depth is not None else "float32"


@contextlib.contextmanager
def autocast(precision: Precision, device: torch.device) -> Iterator[None]:
    """Compute in `precision` on `device` within the context."""
    # Process-wide settings, set again each time: code from torch.hub may have changed them.
    torch.backends.cudnn.allow_tf32 = False
    torch.set_float32_matmul_precision("highest")
    if precision == "float32":
        yield
        return
    with torch.autocast(device.type, torch.bfloat16):
        yield


@dataclass(frozen=True, slots=True)
class GpuMemory:
    """Memory of one GPU."""

    name: str
    """`cuda:0`"""
    used_bytes: int
    """Reserved by PyTorch in this process, its cache included."""
    total_bytes: int


def gpu_memory() -> list[GpuMemory]:
    """Return the memory of each GPU that this process uses; empty if CUDA is not initialized."""
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
