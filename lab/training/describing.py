"""Describes photos without a server: decodes them batch by batch, and applies a network."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from PIL import Image

from lab.evaluation.ranking import Rows, refused_photos_error
from shared.descriptors.backbones import normalise_pixels
from shared.descriptors.inference import (
    BatchSizeLimit,
    PhotoTooLargeForGpu,
    autocast,
    inference_clock,
    run_in_batches,
)
from shared.errors import InvalidRequest, PlacewiseError
from shared.extractor_config.names import IMAGENET_MEAN, IMAGENET_STD
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import Pixels, Preprocessing, get_preprocessing, squeeze_name

Photo = TypeVar("Photo")
Refused = list[tuple[Any, PlacewiseError]]
"""Photos that can't be described, and why"""


class PhotoDecoder:
    """Decodes photos in batches, in threads.

    Args:
        preprocessing: Makes the (height, width, 3) uint8 pixels.
        batch_photos: Number of photos of a batch.
        max_pixels: Larger photos are refused.
        read: Returns the bytes of a photo; photos are files by default.
        ahead: Whether the next batch is decoded meanwhile, which on a CPU would slow a network.
    """

    def __init__(
        self,
        preprocessing: Preprocessing,
        batch_photos: int,
        max_pixels: int,
        *,
        read: Callable[[Any], bytes] = Path.read_bytes,
        ahead: bool = False,
    ) -> None:
        self.preprocessing = preprocessing
        self._batch_photos, self._max_pixels = batch_photos, max_pixels
        self._read, self._ahead = read, ahead

    def batches(
        self, photos: Sequence[Photo], refused: Refused
    ) -> Iterator[tuple[list[Photo], list[Pixels]]]:
        """Yield the photos of each batch with their pixels; the others are added to `refused`."""
        step = self._batch_photos
        with ThreadPoolExecutor(os.cpu_count()) as threads:  # decoding releases the GIL
            following: Iterator[Pixels | PlacewiseError] | None = None
            for start in range(0, len(photos), step):
                batch = photos[start : start + step]
                decoded = list(following or threads.map(self._decode, batch))
                if self._ahead:
                    following = threads.map(self._decode, photos[start + step : start + 2 * step])
                kept, pixels = [], []
                for photo, result in zip(batch, decoded, strict=True):
                    if isinstance(result, PlacewiseError):
                        refused.append((photo, result))
                    else:
                        kept.append(photo)
                        pixels.append(result)
                yield kept, pixels

    def _decode(self, photo: Any) -> Pixels | PlacewiseError:
        try:
            return decode_photo(self._read(photo), self.preprocessing, self._max_pixels).pixels
        except OSError as error:
            return InvalidRequest("photo_unreadable", f"Can't read the file: {error.strerror}.")
        except PlacewiseError as error:
            return error


class PhotoDescriber:
    """Describes photos batch by batch: pixels of b photos -> (b, D) float32 rows.

    `seconds` is the time spent in `describe`, by `inference_clock`, for `photos` photos.
    """

    def __init__(
        self,
        describe: Callable[[list[Pixels]], Rows],
        decoder: PhotoDecoder,
        device: torch.device,
    ) -> None:
        self._describe, self._decoder, self._device = describe, decoder, device
        self.seconds = 0.0
        self.photos = 0

    def __call__(self, photos: Sequence[Any]) -> Iterator[Rows]:
        """Yield (b, D) float32 descriptors in the order of the photos.

        After the first photo that can't be described, the others are only decoded.

        Raises:
            Unprocessable: `photos_refused`, for all photos that can't be described.
        """
        refused: Refused = []
        clock = inference_clock(self._device)
        for batch, pixels in self._decoder.batches(photos, refused):
            if refused:
                continue
            started_at = clock()
            try:
                rows = self._describe(pixels)
            except PhotoTooLargeForGpu as error:
                refused.append((batch[error.place], error))
                continue
            self.seconds += clock() - started_at
            self.photos += len(rows)
            yield rows
        if refused:
            raise refused_photos_error(refused, len(photos))


class ModelDescriber(PhotoDescriber):
    """Describes photo files with a network, (B, 3, H, W) float32 -> (B, D).

    Photos are normalised as for ImageNet. The network's training mode is restored after each call.

    Args:
        image_size: (height, width) to which photos are resized without keeping the aspect ratio,
            antialiased, as in training. None keeps each photo's size; photos of equal size form a
            batch.
        interpolation: `bilinear` or `bicubic`.
        batch_photos: number of photos read and described at a time.
        max_pixels: larger photos are refused.
    """

    def __init__(
        self,
        model: torch.nn.Module,
        device: torch.device,
        image_size: tuple[int, int] | None,
        *,
        interpolation: str = "bilinear",
        batch_photos: int = 32,
        max_pixels: int = 50_000_000,
    ) -> None:
        self._model = model
        self.preprocessing = (
            get_preprocessing(squeeze_name(image_size, interpolation))
            if image_size is not None
            else Preprocessing("native", 1, True, max_pixels, (480, 640), _keep_size)
        )
        self._limit = BatchSizeLimit(device)
        ahead = device.type != "cpu"
        decoder = PhotoDecoder(self.preprocessing, batch_photos, max_pixels, ahead=ahead)
        super().__init__(self._describe_pixels, decoder, device)

    def __call__(self, photos: Sequence[Path]) -> Iterator[Rows]:
        """Yield descriptors as `PhotoDescriber` does."""
        was_training = self._model.training
        self._model.eval()
        try:
            yield from super().__call__(photos)
        finally:
            self._model.train(was_training)

    def _describe_pixels(self, pixels: list[Pixels]) -> Rows:
        rows: Rows | None = None
        for indices, outputs in run_in_batches(pixels, self._forward, self._limit, self._device):
            if rows is None:
                rows = np.empty((len(pixels), outputs.shape[1]), np.float32)
            rows[indices] = outputs.numpy()
        assert rows is not None, "a batch has at least one photo"
        return rows

    def _forward(self, pixels: Pixels) -> torch.Tensor:
        with torch.inference_mode(), autocast("float32", self._device):
            stacked = torch.from_numpy(np.ascontiguousarray(pixels)).to(self._device)
            photos = normalise_pixels(stacked, IMAGENET_MEAN, IMAGENET_STD)
            rows: torch.Tensor = self._model(photos)
            return rows.float().cpu()


def _keep_size(image: Image.Image) -> Pixels:
    return np.asarray(image)
