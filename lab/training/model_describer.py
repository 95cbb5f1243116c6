"""Describes photos with a place descriptor network, in validation and from a checkpoint."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from lab.evaluation.ranking import Rows, refused_photos_error
from shared.descriptors.inference import (
    BatchSizeLimit,
    PhotoTooLargeForGpu,
    inference_clock,
    run_in_batches,
)
from shared.errors import InvalidRequest, PlacewiseError, Unprocessable
from shared.extractor_config.names import IMAGENET_MEAN, IMAGENET_STD
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import Pixels, Preprocessing, get_preprocessing, squeeze_name


class ModelDescriber:
    """Computes the descriptors of photo files with a network, (B, 3, H, W) float32 -> (B, D).

    Photos are normalised as for ImageNet. The network's training mode is restored after each call.

    Args:
        image_size: (height, width) to which photos are resized without keeping the aspect ratio,
            antialiased, as in training. None keeps each photo's size; photos of equal size form a
            batch.
        interpolation: `bilinear` or `bicubic`.
        batch_photos: number of photos read and described at a time.
        max_pixels: larger photos are refused.

    `seconds` is the time spent in the network, by `inference_clock`, for `photos` photos.
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
        self._device = device
        self._batch_photos = batch_photos
        self._max_pixels = max_pixels
        self.preprocessing = (
            get_preprocessing(squeeze_name(image_size, interpolation))
            if image_size is not None
            else Preprocessing("native", 1, True, max_pixels, (480, 640), _keep_size)
        )
        self._limit = BatchSizeLimit(device)
        self.seconds = 0.0
        self.photos = 0
        self._mean = torch.tensor(IMAGENET_MEAN, device=device)[:, None, None] * 255
        self._std = torch.tensor(IMAGENET_STD, device=device)[:, None, None] * 255

    def __call__(self, photos: Sequence[Path]) -> Iterator[Rows]:
        """Yield (n, D) float32 descriptors, batch by batch, in the order of the photos.

        Raises one error for all photos that cannot be read, decoded or processed.
        """
        refused: list[tuple[Path, PlacewiseError]] = []
        was_training = self._model.training
        self._model.eval()
        clock = inference_clock(self._device)
        try:
            for batch, decoded in self._decode_batches(photos):
                pixels = []
                for photo, result in zip(batch, decoded, strict=True):
                    if isinstance(result, PlacewiseError):
                        refused.append((photo, result))
                    else:
                        pixels.append(result)
                if refused:  # only look for more unreadable photos
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
        finally:
            self._model.train(was_training)
        if refused:
            raise refused_photos_error(refused, len(photos))

    def _decode_batches(
        self, photos: Sequence[Path]
    ) -> Iterator[tuple[Sequence[Path], list[Pixels | PlacewiseError]]]:
        """Decode batch by batch; on a GPU one ahead, which on a CPU would slow the network."""
        step, decodes_ahead = self._batch_photos, self._device.type != "cpu"
        with ThreadPoolExecutor(os.cpu_count()) as threads:  # decoding releases the GIL
            ahead = None
            for start in range(0, len(photos), step):
                batch = photos[start : start + step]
                decoded = list(ahead or threads.map(self._decode, batch))
                if decodes_ahead:
                    following = photos[start + step : start + 2 * step]
                    ahead = threads.map(self._decode, following)
                yield batch, decoded

    def _decode(self, photo: Path) -> Pixels | PlacewiseError:
        try:
            return decode_photo(photo.read_bytes(), self.preprocessing, self._max_pixels).pixels
        except OSError as error:
            return InvalidRequest("photo_unreadable", f"Can't read the file: {error.strerror}.")
        except Unprocessable as error:
            return error

    def _describe(self, pixels: list[Pixels]) -> Rows:
        rows: Rows | None = None
        for indices, outputs in run_in_batches(pixels, self._forward, self._limit, self._device):
            if rows is None:
                rows = np.empty((len(pixels), outputs.shape[1]), np.float32)
            rows[indices] = outputs.numpy()
        assert rows is not None, "a batch has at least one photo"
        return rows

    def _forward(self, pixels: Pixels) -> torch.Tensor:
        with torch.inference_mode():
            stacked = torch.from_numpy(np.ascontiguousarray(pixels)).to(self._device)
            photos = stacked.permute(0, 3, 1, 2).float()
            rows: torch.Tensor = self._model((photos - self._mean) / self._std)
            return rows.float().cpu()


def _keep_size(image: Image.Image) -> Pixels:
    return np.asarray(image)
