"""Training data: the selected sets, batch sampler, dataset, augmentation and data loader.

A batch holds P places x K photos. The batches of an epoch are a function of (seed, epoch) only, not
of earlier random draws. A run that resumes in the middle of an epoch, with any number of workers,
gets the same batches as an uninterrupted run.
"""

from __future__ import annotations

import signal
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from torchvision import transforms as tv

from lab.datasets.dataset import EvaluationSet, TrainingPlace, TrainingSet
from lab.datasets.open_dataset import evaluation_set_names, open_evaluation_set, open_training_set
from lab.training.arguments import TrainingArguments, data_root_error, suggest_name
from lab.training.photo_decoding import decode_resized
from shared.errors import NotFound, Unprocessable

ORDER_STREAM, PHOTO_STREAM, AUGMENT_STREAM = 1, 2, 3  # keep the random streams independent


@dataclass(frozen=True, slots=True)
class EvaluationSets:
    """Evaluation sets of a run. Sets that the phase does not use are not opened."""

    validation: tuple[EvaluationSet, ...]
    """empty in the phase test"""
    test: tuple[EvaluationSet, ...]
    """empty in the phase train"""
    roots: dict[str, Path]
    """name of each available set -> the folder of the arguments that it is in"""
    names: dict[str, tuple[str, ...]]
    """resolved values of val_set_names and test_set_names"""


def select_training_set(arguments: TrainingArguments) -> TrainingSet:
    """Open the training set; without explicit `cities`, all cities of the folder.

    Raises InvalidRequest: `data_root_missing`; also raises what `open_training_set` raises.
    """
    is_explicit = "cities" in arguments.model_fields_set
    return open_training_set(
        _require_data_root(arguments),
        arguments.cities if is_explicit else None,
        min_photos=arguments.min_img_per_place,
    )


def select_evaluation_sets(arguments: TrainingArguments) -> EvaluationSets:
    """Open the validation and test sets that the phase uses.

    Sets that are named explicitly must exist. Otherwise the sets with the default names are used;
    if there are none, those with `val` in their names for validation and `test` for tests; if there
    are none of these either, all sets of the folder.

    Raises NotFound (`set_missing`), InvalidRequest (`data_root_missing`).
    """
    roots = arguments.eval_roots or (_require_data_root(arguments),)
    available: dict[str, Path] = {}
    for root in roots:
        for name in evaluation_set_names(root):
            available.setdefault(name, root)
    names = {
        "val_set_names": _resolve_set_names(arguments, "val_set_names", "val", available),
        "test_set_names": _resolve_set_names(arguments, "test_set_names", "test", available),
    }
    opened: dict[str, EvaluationSet] = {}

    def open_sets(argument: str) -> tuple[EvaluationSet, ...]:
        for name in names[argument]:
            if name not in available:
                raise NotFound(
                    "set_missing",
                    f"--{argument}: there is no set {name!r} in "
                    f"{', '.join(str(root) for root in roots)}."
                    + (
                        suggest_name(name, available)
                        if available
                        else " No evaluation set was recognised there."
                    ),
                )
            if name not in opened:
                opened[name] = open_evaluation_set(available[name], name)
        return tuple(opened[name] for name in names[argument])

    phase = arguments.experiment_phase
    return EvaluationSets(
        validation=open_sets("val_set_names") if phase != "test" else (),
        test=open_sets("test_set_names") if phase != "train" else (),
        names=names,
        roots=available,
    )


def _resolve_set_names(
    arguments: TrainingArguments, argument: str, keyword: str, available: Iterable[str]
) -> tuple[str, ...]:
    names: tuple[str, ...] = getattr(arguments, argument)
    if argument in arguments.model_fields_set:
        return names
    return (
        tuple(name for name in names if name in available)
        or tuple(name for name in available if keyword in name)
        or tuple(available)
    )


def _require_data_root(arguments: TrainingArguments) -> Path:
    if arguments.data_root is None:
        raise data_root_error()
    return arguments.data_root


@dataclass(frozen=True, slots=True)
class PlaceSample:
    """The photos of one place that are part of a batch."""

    place: int
    """index into the training set's places"""
    photos: tuple[int, ...]
    """indices into the place's photos"""
    seed: int
    """seed of the augmentation of these photos"""


@dataclass(frozen=True)
class PlaceBatchSampler:
    """Samples batches of P places x K photos, as the GSV-Cities code does.

    The last batch of an epoch may be smaller.
    """

    places: Sequence[TrainingPlace]
    places_per_batch: int
    """P"""
    photos_per_place: int
    """K"""
    shuffle_all: bool
    """shuffle all places. If false, cities keep their order and places are shuffled within each
    city; a batch then (almost) always holds one city, whose places are hard to distinguish"""
    random_photos: bool
    """draw a place's photos without replacement in each epoch. If false, use its first K photos"""
    reshuffle_every_epochs: int
    """number of epochs between shuffles of the places; 0: shuffle once"""
    seed: int
    """seed of the order, the photos and the augmentation"""

    def __len__(self) -> int:
        return -(-len(self.places) // self.places_per_batch)

    def batches(self, epoch: int, start: int = 0) -> Iterator[list[PlaceSample]]:
        """Yield the epoch's batches, beginning with batch number `start`."""
        order = self.order(epoch)
        for number in range(start, len(self)):
            first = number * self.places_per_batch
            rng = np.random.default_rng((self.seed, PHOTO_STREAM, epoch, number))
            seeds = np.random.default_rng((self.seed, AUGMENT_STREAM, epoch, number))
            yield [
                PlaceSample(
                    int(place), self._sample_photos(int(place), rng), int(seeds.integers(2**63))
                )
                for place in order[first : first + self.places_per_batch]
            ]

    def step_batches(self, steps: range) -> Iterator[list[PlaceSample]]:
        """Yield the batches of consecutive steps, counted through all epochs."""
        while steps:
            epoch, start = divmod(steps[0], len(self))
            for _, batch in zip(steps, self.batches(epoch, start), strict=False):
                yield batch
            steps = steps[len(self) - start :]

    def order(self, epoch: int) -> NDArray[np.int64]:
        """Return the indices of all places in the order of the epoch, (places,) int64."""
        interval = self.reshuffle_every_epochs
        rng = np.random.default_rng((self.seed, ORDER_STREAM, epoch // interval if interval else 0))
        if self.shuffle_all:
            return rng.permutation(len(self.places))
        return np.concatenate([rng.permutation(indices) for indices in self._indices_by_city()])

    def _indices_by_city(self) -> list[NDArray[np.int64]]:
        by_city: dict[str, list[int]] = {}
        for index, place in enumerate(self.places):
            by_city.setdefault(place.city, []).append(index)
        return [np.array(indices, np.int64) for indices in by_city.values()]

    def _sample_photos(self, place: int, rng: np.random.Generator) -> tuple[int, ...]:
        count = len(self.places[place].photos)
        if not self.random_photos:
            return tuple(range(self.photos_per_place))
        chosen = rng.choice(count, self.photos_per_place, replace=False)
        return tuple(int(photo) for photo in chosen)


RANDAUGMENT_OPERATIONS = 3


@dataclass(frozen=True, slots=True)
class PhotoTransform:
    """How a training photo is resized and augmented."""

    size: tuple[int, int]
    """height and width in pixels"""
    interpolation: str = "bilinear"
    """of the resize and the augmentation: `bilinear` or `bicubic`"""
    magnitude: int | None = 9
    """strength of RandAugment, from 0 to 30; None: no augmentation"""

    def load(self, path: Path, seed: int) -> Image.Image:
        """Decode, resize and augment a photo; raises what `decode_resized` raises."""
        resampling = Image.Resampling[self.interpolation.upper()]
        image = decode_resized(path, self.size, resampling=resampling)
        return image if self.magnitude is None else self.augment(image, seed)

    def augment(self, image: Image.Image, seed: int) -> Image.Image:
        """Apply RandAugment (Cubuk et al. 2020) with three operations, deterministic for a seed."""
        randaugment = tv.RandAugment(
            num_ops=RANDAUGMENT_OPERATIONS,
            magnitude=self.magnitude,
            interpolation=tv.InterpolationMode(self.interpolation),
        )
        # RandAugment draws from the global generator, which the training steps also use.
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)  # the CPU's; manual_seed also seeds GPUs
            augmented: Image.Image = randaugment(image)
        return augmented


class Batch(NamedTuple):
    """Photos and place labels of one training step."""

    photos: Tensor
    """(n, H, W, 3) uint8; n is P x K minus the photos that cannot be decoded"""
    labels: Tensor
    """(n,) int64 place ids"""
    undecodable: tuple[tuple[str, str], ...] = ()
    """path and reason of each skipped photo"""


class PlaceDataset(Dataset[Batch]):
    """Decodes and augments the photos of one `PlaceSample`.

    A photo that cannot be decoded is listed in `Batch.undecodable`, or with `fail_on_undecodable`
    raises Unprocessable (`undecodable_photo`).
    """

    def __init__(
        self,
        sampler: PlaceBatchSampler,
        transform: PhotoTransform,
        *,
        fail_on_undecodable: bool,
    ) -> None:
        self.sampler = sampler
        self._transform = transform
        self._fail_on_undecodable = fail_on_undecodable

    def __getitem__(self, sample: PlaceSample) -> Batch:
        place = self.sampler.places[sample.place]
        photos: list[Tensor] = []
        undecodable: list[tuple[str, str]] = []
        for position, index in enumerate(sample.photos):
            path = place.photos[index]
            try:
                image = self._transform.load(path, sample.seed + position)
            except Unprocessable as error:
                if self._fail_on_undecodable:
                    raise Unprocessable(
                        "undecodable_photo",
                        f"{path} cannot be decoded: {error.detail}. Repair or remove it, or skip "
                        "such photos with --on_bad_image skip.",
                    ) from error
                undecodable.append((str(path), error.detail))
                continue
            photos.append(torch.from_numpy(np.array(image)))
        empty = torch.empty((0, *self._transform.size, 3), dtype=torch.uint8)
        return Batch(
            torch.stack(photos) if photos else empty,
            torch.full((len(photos),), place.place_id, dtype=torch.int64),
            tuple(undecodable),
        )


def _join(parts: list[Batch]) -> Batch:
    return Batch(
        torch.cat([part.photos for part in parts]),
        torch.cat([part.labels for part in parts]),
        tuple(each for part in parts for each in part.undecodable),
    )


PART_PLACES = 8  # of a batch, which a worker loads: the first batch is made by several


def load_batches(dataset: PlaceDataset, steps: range, *, num_workers: int) -> Iterator[Batch]:
    """Load the batches of the steps; workers read two ahead, also into the next epoch."""
    sampler = dataset.sampler
    parts_of_batch = -(-sampler.places_per_batch // PART_PLACES)
    parts = iter(
        DataLoader(
            dataset,
            batch_sampler=(
                batch[first : first + PART_PLACES]
                for batch in sampler.step_batches(steps)
                for first in range(0, len(batch), PART_PLACES)
            ),
            num_workers=num_workers,
            prefetch_factor=-(-2 * parts_of_batch // num_workers) if num_workers else None,
            collate_fn=_join,
            worker_init_fn=_init_worker if num_workers else None,
            generator=torch.Generator(),  # else it would draw from the training's global generator
        )
    )
    for batch in sampler.step_batches(steps):
        yield _join([next(parts) for _ in range(0, len(batch), PART_PLACES)])


def _init_worker(worker_id: int) -> None:
    # The parent handles them: it saves the run, then ends its workers. Ctrl-C, timeout and systemd
    # signal the whole process group.
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, signal.SIG_IGN)
    torch.set_num_threads(1)
