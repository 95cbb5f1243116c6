"""Which photos make up which batch: P places x K photos, decided by the seed alone.

An epoch's batches are a function of (seed, epoch), not of what was drawn before: a run that goes on
in the middle of an epoch, with however many workers, gets what it would have got.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.datasets.sets import TrainingPlace

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
