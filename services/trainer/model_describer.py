"""Photos described by a network of place descriptors, in training and from a checkpoint."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from shared.descriptors.inference import BatchSizeLimit, PhotoTooLargeForGpu, run_in_batches
from shared.errors import InvalidRequest, PlacewiseError, Unprocessable
from shared.evaluation.ranking import Rows, refused_photos_error
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import Pixels, Preprocessing, get_preprocessing

# The means and deviations of ImageNet's channels, with which the backbones were trained.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class ModelDescriber:
    """Calls a network (B, 3, H, W) float32, ImageNet-normalised -> (B, D) on photos.

    `image_size`: (height, width), to which photos are squeezed, bilinear and antialiased, as in
    training; None keeps each photo's own size, and photos of one size go through together.
    The network is left in the mode, training or not, in which it came.
    """

    def __init__(
        self,
        model: torch.nn.Module,
        device: torch.device,
        image_size: tuple[int, int] | None,
        *,
        batch_photos: int = 32,
        max_pixels: int = 50_000_000,
    ) -> None:
        self._model = model
        self._device = device
        self._batch_photos = batch_photos
        self._max_pixels = max_pixels
        self.preprocessing = (
            get_preprocessing(f"resize{image_size[0]}x{image_size[1]}")
            if image_size is not None
            else Preprocessing("native", 1, True, max_pixels, (480, 640), _keep_size)
        )
        self._limit = BatchSizeLimit()
        self.seconds = 0.0
        """spent in the network, of `photos`; they are read and decoded meanwhile"""
        self.photos = 0
        self._mean = torch.tensor(IMAGENET_MEAN, device=device)[:, None, None] * 255
        self._deviation = torch.tensor(IMAGENET_STD, device=device)[:, None, None] * 255

    def __call__(self, photos: Sequence[Path]) -> Iterator[Rows]:
        refused: list[tuple[Path, PlacewiseError]] = []
        was_training = self._model.training
        self._model.eval()
        threads = ThreadPoolExecutor(max(1, os.cpu_count() or 1))  # decoding releases the GIL
        try:
            ahead = [threads.submit(self._read, p) for p in photos[: self._batch_photos]]
            for begin in range(0, len(photos), self._batch_photos):
                batch = [future.result() for future in ahead]
                end = begin + self._batch_photos
                following = photos[end : end + self._batch_photos]
                ahead = [threads.submit(self._read, photo) for photo in following]
                here = photos[begin:end]
                refused += [
                    (photo, outcome)
                    for photo, outcome in zip(here, batch, strict=True)
                    if isinstance(outcome, PlacewiseError)
                ]
                if not refused:  # after a refusal, the rest is read for what else is unreadable
                    pixels = [p for p in batch if not isinstance(p, PlacewiseError)]
                    begun = time.perf_counter()
                    try:
                        rows = self._rows(pixels)
                    except PhotoTooLargeForGpu as error:
                        refused.append((here[error.place], error))
                        continue
                    self.seconds += time.perf_counter() - begun
                    self.photos += len(rows)
                    yield rows
        finally:
            threads.shutdown(cancel_futures=True)
            self._model.train(was_training)
        if refused:
            raise refused_photos_error(refused, len(photos))

    def _read(self, photo: Path) -> Pixels | PlacewiseError:
        try:
            return decode_photo(photo.read_bytes(), self.preprocessing, self._max_pixels).pixels
        except OSError as error:
            return InvalidRequest("photo_unreadable", f"It can't be read: {error.strerror}.")
        except Unprocessable as error:
            return error

    def _rows(self, pixels: list[Pixels]) -> Rows:
        rows: Rows | None = None
        for places, found in run_in_batches(pixels, self._run, self._limit, self._device):
            if rows is None:
                rows = np.empty((len(pixels), found.shape[1]), np.float32)
            rows[places] = found.numpy()
        assert rows is not None, "a batch has a photo"
        return rows

    def _run(self, pixels: Pixels) -> torch.Tensor:
        with torch.inference_mode():
            stacked = torch.from_numpy(np.ascontiguousarray(pixels)).to(self._device)
            photos = stacked.permute(0, 3, 1, 2).float()
            rows: torch.Tensor = self._model((photos - self._mean) / self._deviation)
            return rows.float().cpu()


def _keep_size(image: Image.Image) -> Pixels:
    return np.asarray(image)
