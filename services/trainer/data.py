"""Batches of photos for training: read by workers ahead of their use, resumable inside an epoch.

Which photos make up which batch: P places x K photos, decided by the seed alone.

An epoch's batches are a function of (seed, epoch), not of what was drawn before: a run that goes on
in the middle of an epoch, with however many workers, gets what it would have got.

What a photo goes through before the network learns from it.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from torchvision import transforms as tv

from shared.datasets.open_dataset import TrainingPlace
from shared.errors import Unprocessable
from shared.imaging.decode import decode_resized

ORDER_STREAM, PHOTO_STREAM, AUGMENT_STREAM = 1, 2, 3  # what a stream of random numbers is for


@dataclass(frozen=True, slots=True)
class PlaceSample:
    """One place in a batch."""

    place: int
    """index among the training set's places"""
    photos: tuple[int, ...]
    """indices among the place's photos"""
    seed: int
    """of the augmentation of these photos"""


@dataclass(frozen=True)
class PlaceBatchSampler:
    """Batches of places, as the predecessor samples them.

    `shuffle_all` False keeps the cities' order and shuffles the places inside each: a batch then
    holds (almost) one city, whose places are hard to tell apart. Places are shuffled anew every
    `reshuffle_every_epochs`; 0: once. With `random_photos` the photos of a place are drawn without
    replacement, in every epoch; else they are its first ones. The last batch may be smaller.
    """

    places: Sequence[TrainingPlace]
    places_per_batch: int
    photos_per_place: int
    shuffle_all: bool
    random_photos: bool
    reshuffle_every_epochs: int
    seed: int

    def __len__(self) -> int:
        return -(-len(self.places) // self.places_per_batch)

    def batches(self, epoch: int, start: int = 0) -> Iterator[list[PlaceSample]]:
        """The epoch's batches from number `start` on."""
        order = self.order(epoch)
        for number in range(start, len(self)):
            first = number * self.places_per_batch
            rng = np.random.default_rng((self.seed, PHOTO_STREAM, epoch, number))
            seeds = np.random.default_rng((self.seed, AUGMENT_STREAM, epoch, number))
            yield [
                PlaceSample(int(place), self._photos(int(place), rng), int(seeds.integers(2**63)))
                for place in order[first : first + self.places_per_batch]
            ]

    def order(self, epoch: int) -> NDArray[np.int64]:
        """The indices of all places as the epoch goes through them."""
        every = self.reshuffle_every_epochs
        rng = np.random.default_rng((self.seed, ORDER_STREAM, epoch // every if every else 0))
        if self.shuffle_all:
            return rng.permutation(len(self.places))
        return np.concatenate([rng.permutation(indices) for indices in self._indices_by_city()])

    def _indices_by_city(self) -> list[NDArray[np.int64]]:
        by_city: dict[str, list[int]] = {}
        for index, place in enumerate(self.places):
            by_city.setdefault(place.city, []).append(index)
        return [np.array(indices, np.int64) for indices in by_city.values()]

    def _photos(self, place: int, rng: np.random.Generator) -> tuple[int, ...]:
        count = len(self.places[place].photos)
        if not self.random_photos:
            return tuple(range(self.photos_per_place))
        chosen = rng.choice(count, self.photos_per_place, replace=False)
        return tuple(int(photo) for photo in chosen)


RANDAUGMENT_OPERATIONS = 3
RANDAUGMENT_MAGNITUDE = 9
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

_randaugment = tv.RandAugment(
    num_ops=RANDAUGMENT_OPERATIONS,
    magnitude=RANDAUGMENT_MAGNITUDE,
    interpolation=tv.InterpolationMode.BILINEAR,
)


def apply_randaugment(image: Image.Image, seed: int) -> Image.Image:
    """Three operations of RandAugment (Cubuk et al. 2020), the same for the same seed."""
    # RandAugment draws from the global generator, which is the training's own elsewhere.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        changed: Image.Image = _randaugment(image)
    return changed


def to_tensor(image: Image.Image) -> Tensor:
    """RGB -> (3, H, W) float32, normalised by ImageNet's means and deviations."""
    pixels = torch.from_numpy(np.array(image, np.uint8)).permute(2, 0, 1)
    mean = torch.tensor(IMAGENET_MEAN)[:, None, None]
    deviation = torch.tensor(IMAGENET_STD)[:, None, None]
    return (pixels.float() / 255 - mean) / deviation


@dataclass(frozen=True, slots=True)
class Batch:
    photos: Tensor
    """(n, 3, H, W) float32; n is P x K without the photos that do not decode"""
    labels: Tensor
    """(n,) int64 place ids"""
    undecodable: tuple[tuple[str, str], ...] = ()
    """path and reason of each photo left out"""

    def to(self, device: torch.device, non_blocking: bool = False) -> Batch:
        return Batch(
            self.photos.to(device, non_blocking=non_blocking),
            self.labels.to(device, non_blocking=non_blocking),
            self.undecodable,
        )

    def pin_memory(self) -> Batch:
        return Batch(self.photos.pin_memory(), self.labels.pin_memory(), self.undecodable)


class PlaceDataset(Dataset[Batch]):
    """The photos of one `PlaceSample`, decoded, augmented, normalised.

    A photo that does not decode is left out and named in `bad`, or is Unprocessable
    (`undecodable_photo`) with `bad_is_error`.
    """

    def __init__(
        self,
        plan: PlaceBatchSampler,
        image_size: tuple[int, int],
        *,
        augment: bool = True,
        fail_on_undecodable: bool,
    ) -> None:
        self._places = plan.places
        self._image_size = image_size
        self._augment = augment
        self._fail_on_undecodable = fail_on_undecodable

    def __getitem__(self, draw: PlaceSample) -> Batch:
        place = self._places[draw.place]
        photos: list[Tensor] = []
        bad: list[tuple[str, str]] = []
        for position, number in enumerate(draw.photos):
            path = place.photos[number]
            try:
                image = decode_resized(path, self._image_size)
            except Unprocessable as error:
                if self._fail_on_undecodable:
                    raise undecodable_photo_error(str(path), error.detail) from error
                bad.append((str(path), error.detail))
                continue
            if self._augment:
                image = apply_randaugment(image, draw.seed + position)
            photos.append(to_tensor(image))
        empty = torch.empty((0, 3, *self._image_size))
        return Batch(
            torch.stack(photos) if photos else empty,
            torch.full((len(photos),), place.place_id, dtype=torch.int64),
            tuple(bad),
        )


def undecodable_photo_error(path: str, reason: str) -> Unprocessable:
    return Unprocessable(
        "undecodable_photo",
        f"{path} does not decode: {reason}. Mend or remove it, or leave such photos out: "
        "--on_bad_image skip.",
    )


def collate_batches(parts: list[Batch]) -> Batch:
    """Places one after the other."""
    return Batch(
        torch.cat([part.photos for part in parts]),
        torch.cat([part.labels for part in parts]),
        tuple(each for part in parts for each in part.undecodable),
    )


class ResumableDataLoader:
    """All batches of one epoch after the other; Lightning takes it for a data loader.

    Its state is the number of batches that were handed out, so that training goes on behind them.
    `seconds_waited` counts how long whoever takes batches has waited for them.
    """

    def __init__(
        self, plan: PlaceBatchSampler, photos: PlaceDataset, *, num_workers: int, pin_memory: bool
    ) -> None:
        self.plan = plan
        self.sampler = self  # where Lightning tells the epoch: set_epoch
        self.seconds_waited = 0.0
        self._photos = photos
        self._num_workers = num_workers
        self._pin_memory = pin_memory
        self._epoch = 0
        self._batches_yielded = 0

    def __len__(self) -> int:
        return len(self.plan)

    def set_epoch(self, epoch: int) -> None:
        if epoch != self._epoch:
            self._epoch, self._batches_yielded = epoch, 0

    def state_dict(self) -> dict[str, Any]:
        return {"epoch": self._epoch, "given": self._batches_yielded}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._epoch, self._batches_yielded = state["epoch"], state["given"]

    def __iter__(self) -> Iterator[Batch]:
        # A generator: nothing is read before the first batch is taken, when the epoch is known.
        if self._batches_yielded >= len(self.plan):
            self._batches_yielded = 0
        loader: DataLoader[Batch] = DataLoader(
            self._photos,
            batch_sampler=_RemainingBatches(self.plan, self._epoch, self._batches_yielded),
            num_workers=self._num_workers,
            collate_fn=collate_batches,
            pin_memory=self._pin_memory,
            worker_init_fn=_init_worker if self._num_workers else None,
            generator=torch.Generator(),  # else it draws from that of the steps
        )
        batches = iter(loader)
        while True:
            began = time.perf_counter()
            batch = next(batches, None)
            self.seconds_waited += time.perf_counter() - began
            if batch is None:
                return
            self._batches_yielded += 1
            yield batch


class _RemainingBatches:
    """The rest of an epoch as torch's loader asks for it: lists of what to read."""

    def __init__(self, plan: PlaceBatchSampler, epoch: int, start: int) -> None:
        self._plan, self._epoch, self._start = plan, epoch, start

    def __len__(self) -> int:
        return len(self._plan) - self._start

    def __iter__(self) -> Iterator[list[PlaceSample]]:
        return self._plan.batches(self._epoch, self._start)


def _init_worker(number: int) -> None:
    # Ctrl-C is for the parent, which ends its workers after it has kept the run.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
