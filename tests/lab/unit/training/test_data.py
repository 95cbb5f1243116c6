"""Which photos make up which batch, and what they go through."""

from __future__ import annotations

import itertools
import signal
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lab.datasets.dataset import TrainingPlace
from lab.training.data import (
    Batch,
    PhotoTransform,
    PlaceBatchSampler,
    PlaceDataset,
    PlaceSample,
    _init_worker,
    load_batches,
)
from lab.training.photo_decoding import decode_resized
from tests.support.waiting import wait_until


def places_of(**counts: int) -> list[TrainingPlace]:
    """So many places of each city, of four to six photos."""
    found = []
    for number, (city, count) in enumerate(counts.items()):
        for place in range(count):
            photos = tuple(Path(f"{city}/{place}_{photo}.jpg") for photo in range(4 + place % 3))
            found.append(TrainingPlace(number * 10**5 + place, city, photos))
    return found


PLAN = PlaceBatchSampler(
    places_of(oslo=10, rome=7),
    places_per_batch=4,
    photos_per_place=3,
    shuffle_all=False,
    random_photos=True,
    reshuffle_every_epochs=1,
    seed=1,
)


def cities(plan: PlaceBatchSampler, epoch: int = 0) -> list[str]:
    return [plan.places[draw.place].city for batch in plan.batches(epoch) for draw in batch]


def test_an_epoch_takes_every_place_once_and_draws_its_photos_without_replacement() -> None:
    batches = list(PLAN.batches(0))
    assert [len(batch) for batch in batches] == [4, 4, 4, 4, 1]
    assert len(PLAN) == 5
    samples = list(itertools.chain.from_iterable(batches))
    assert sorted(sample.place for sample in samples) == list(range(17))
    for sample in samples:
        assert len(set(sample.photos)) == 3
        assert max(sample.photos) < len(PLAN.places[sample.place].photos)


def test_cities_keep_their_order_unless_all_places_are_shuffled() -> None:
    assert cities(PLAN) == ["oslo"] * 10 + ["rome"] * 7
    order = PLAN.order(0).tolist()
    assert order[:10] != sorted(order[:10])
    mixed = cities(replace(PLAN, shuffle_all=True))
    assert Counter(mixed) == {"oslo": 10, "rome": 7}
    assert mixed != cities(PLAN)


def test_places_are_reshuffled_every_n_epochs() -> None:
    every_second = replace(PLAN, reshuffle_every_epochs=2)
    orders = [every_second.order(epoch).tolist() for epoch in range(4)]
    assert orders[0] == orders[1] != orders[2] == orders[3]
    once = replace(PLAN, reshuffle_every_epochs=0)
    assert once.order(0).tolist() == once.order(7).tolist()
    # The photos of a place are other ones nevertheless.
    assert list(once.batches(0)) != list(once.batches(7))


def test_first_photos_are_taken_without_random_sampling() -> None:
    first = replace(PLAN, random_photos=False)
    assert {draw.photos for batch in first.batches(3) for draw in batch} == {(0, 1, 2)}


def test_batches_depend_on_seed_and_epoch_and_not_on_earlier_batches() -> None:
    assert list(PLAN.batches(2)) == list(replace(PLAN).batches(2))
    assert list(PLAN.batches(2)) != list(replace(PLAN, seed=2).batches(2))
    steps = [*list(PLAN.batches(1))[3:], *PLAN.batches(2), *list(PLAN.batches(3))[:1]]
    assert list(PLAN.step_batches(range(8, 16))) == steps


class RecordingDataset(PlaceDataset):
    """Writes a file for each place that it loads."""

    folder: Path

    def __getitem__(self, sample: PlaceSample) -> Batch:
        (self.folder / str(sample.seed)).touch()
        return super().__getitem__(sample)


def test_workers_load_the_next_epoch_before_it_begins(
    photos_on_disk: list[TrainingPlace], tmp_path: Path
) -> None:
    plan = PlaceBatchSampler(photos_on_disk, 2, 2, False, True, 1, 7)
    photos = RecordingDataset(plan, PhotoTransform((32, 48)), fail_on_undecodable=True)
    photos.folder = tmp_path
    batches = load_batches(photos, range(2 * len(plan)), num_workers=1)
    for _ in range(len(plan)):
        next(batches)
    first_of_next_epoch = {str(sample.seed) for sample in next(plan.batches(1))}
    wait_until(lambda: first_of_next_epoch <= {file.name for file in tmp_path.iterdir()})


@pytest.fixture
def photos_on_disk(tmp_path: Path) -> list[TrainingPlace]:
    found = []
    for place in range(4):
        paths = []
        for photo in range(2):
            path = tmp_path / f"{place}_{photo}.jpg"
            noise = np.random.default_rng((place, photo)).integers(0, 255, (40, 60, 3))
            Image.fromarray(noise.astype(np.uint8)).save(path)
            paths.append(path)
        found.append(TrainingPlace(place, "oslo", tuple(paths)))
    return found


def batches_of(places: list[TrainingPlace]) -> Iterator[Batch]:
    plan = PlaceBatchSampler(places, 2, 2, False, True, 1, 7)
    photos = PlaceDataset(plan, PhotoTransform((32, 48)), fail_on_undecodable=True)
    return load_batches(photos, range(len(plan)), num_workers=0)


def test_a_batch_holds_each_places_photos_with_its_id(photos_on_disk: list[TrainingPlace]) -> None:
    batches = list(batches_of(photos_on_disk))
    assert [tuple(batch.photos.shape) for batch in batches] == [(4, 32, 48, 3)] * 2
    labels = torch.cat([batch.labels for batch in batches])
    assert labels.dtype == torch.int64
    assert labels[0::2].tolist() == labels[1::2].tolist()
    assert sorted(labels.tolist()) == [0, 0, 1, 1, 2, 2, 3, 3]


def test_parts_of_a_batch_are_joined_in_its_order(photos_on_disk: list[TrainingPlace]) -> None:
    places = [replace(place, place_id=n) for n in range(5) for place in photos_on_disk]
    plan = PlaceBatchSampler(places, 18, 2, False, True, 1, 7)
    photos = PlaceDataset(plan, PhotoTransform((32, 48)), fail_on_undecodable=True)
    loaded = list(load_batches(photos, range(len(plan)), num_workers=2))
    assert [len(batch.photos) for batch in loaded] == [36, 4]
    for batch, samples in zip(loaded, plan.batches(0), strict=True):
        expected = [photos[sample] for sample in samples]
        assert torch.equal(batch.labels, torch.cat([place.labels for place in expected]))
        assert torch.equal(batch.photos, torch.cat([place.photos for place in expected]))


def test_workers_leave_ctrl_c_and_sigterm_to_the_run_that_saves_itself() -> None:
    endings = {ending: signal.getsignal(ending) for ending in (signal.SIGINT, signal.SIGTERM)}
    threads = torch.get_num_threads()
    try:
        _init_worker(0)
        assert {signal.getsignal(ending) for ending in endings} == {signal.SIG_IGN}
    finally:
        torch.set_num_threads(threads)
        for ending, handler in endings.items():
            signal.signal(ending, handler)


def test_reading_ahead_leaves_the_steps_own_random_numbers_alone(
    photos_on_disk: list[TrainingPlace],
) -> None:
    before = torch.get_rng_state()
    list(batches_of(photos_on_disk))
    assert torch.equal(torch.get_rng_state(), before)


def test_augmentation_is_decided_by_its_seed() -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (32, 32, 3)).astype(np.uint8)
    image = Image.fromarray(pixels)
    usual, strong = PhotoTransform((32, 32)), PhotoTransform((32, 32), magnitude=30)
    first, again, other = (np.asarray(usual.augment(image, seed)) for seed in (5, 5, 6))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(first, np.asarray(strong.augment(image, 5)))


def test_photos_are_resized_bicubically_on_request_and_not_augmented_without_a_magnitude(
    photos_on_disk: list[TrainingPlace],
) -> None:
    path = photos_on_disk[0].photos[0]
    transform = PhotoTransform((50, 70), "bicubic", magnitude=None)
    with Image.open(path) as image:
        expected = image.convert("RGB").resize((70, 50), Image.Resampling.BICUBIC)
    assert np.array_equal(np.asarray(transform.load(path, seed=1)), np.asarray(expected))


def test_a_large_jpeg_decoded_small_is_nearly_the_full_decoding(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    coarse = Image.fromarray(rng.integers(0, 255, (12, 16, 3)).astype(np.uint8))
    full = coarse.resize((1280, 960), Image.Resampling.BICUBIC)
    full.save(tmp_path / "large.jpg", quality=95)
    small = np.asarray(decode_resized(tmp_path / "large.jpg", (120, 160)), dtype=float)
    expected = np.asarray(full.resize((160, 120), Image.Resampling.BILINEAR), dtype=float)
    assert small.shape == (120, 160, 3)
    assert np.abs(small - expected).mean() < 2


def test_the_exif_orientation_is_applied(tmp_path: Path) -> None:
    image = Image.new("RGB", (640, 320))
    image.paste((255, 255, 255), (0, 0, 320, 320))  # the left half
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned clockwise: the left becomes the top
    image.save(tmp_path / "side.jpg", exif=exif)
    upright = np.asarray(decode_resized(tmp_path / "side.jpg", (64, 32)))
    assert upright.shape == (64, 32, 3)
    assert upright[:24].mean() > 250
    assert upright[-24:].mean() < 5
