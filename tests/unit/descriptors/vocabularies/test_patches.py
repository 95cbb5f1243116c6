"""The patches that a vocabulary is fitted on: some of each photo, in a file, read in ranges."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from shared.descriptors import patches as patches_module
from shared.descriptors.patches import PatchFile, max_photos_to_sample, sample_photos
from tests.unit.descriptors.vocabularies.points import unit_points

WIDTH = 8
PHOTOS = 10
PATCHES = 6


@pytest.fixture
def stored_patches(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., PatchFile]]:
    """Stores photos in batches, each photo with a share of `bytes_in_all`."""
    with contextlib.ExitStack() as stack:

        def keep(
            photos: list[torch.Tensor], batch: int, seed: int = 0, bytes_in_all: int = 1_000_000
        ) -> PatchFile:
            monkeypatch.setattr(patches_module, "PATCHES_BYTES", bytes_in_all)
            found = stack.enter_context(PatchFile(WIDTH))
            for first in range(0, len(photos), batch):
                found.add(photos[first : first + batch], first, len(photos), seed)
            return found

        yield keep


def photos() -> list[torch.Tensor]:
    return list(unit_points(1, PHOTOS * PATCHES, WIDTH).reshape(PHOTOS, PATCHES, WIDTH))


def rows(points: torch.Tensor) -> set[tuple[float, ...]]:
    return {tuple(point.tolist()) for point in points}


def test_all_patches_are_kept_where_there_is_room_and_any_piece_can_be_read(
    stored_patches: Callable[..., PatchFile],
) -> None:
    found = stored_patches(photos(), batch=4)
    assert len(found) == PHOTOS * PATCHES
    whole = found.read(0, len(found))
    assert rows(whole) == rows(torch.cat(photos()))
    for begin in range(len(found)):
        for end in range(begin + 1, len(found) + 1):
            assert torch.equal(found.read(begin, end), whole[begin:end])


def test_photos_share_the_room_equally(stored_patches: Callable[..., PatchFile]) -> None:
    found = stored_patches(photos(), batch=4, bytes_in_all=PHOTOS * 2 * WIDTH * 4)
    assert len(found) == PHOTOS * 2
    for number, photo in enumerate(photos()):
        assert rows(found.read(2 * number, 2 * number + 2)) <= rows(photo)


def test_what_is_kept_depends_on_the_seed_and_not_on_the_batches(
    stored_patches: Callable[..., PatchFile],
) -> None:
    little = PHOTOS * 3 * WIDTH * 4
    first = stored_patches(photos(), batch=1, bytes_in_all=little)
    other = stored_patches(photos(), batch=4, bytes_in_all=little)
    assert torch.equal(first.read(0, len(first)), other.read(0, len(other)))
    seeded = stored_patches(photos(), batch=4, seed=1, bytes_in_all=little)
    assert not torch.equal(first.read(0, len(first)), seeded.read(0, len(seeded)))


def test_patches_that_no_centre_can_describe_are_left_out(
    stored_patches: Callable[..., PatchFile],
) -> None:
    flat, odd, *good = photos()[:4]
    odd[2], odd[3] = torch.nan, torch.inf
    found = stored_patches([torch.zeros_like(flat), odd, *good], batch=3)
    assert len(found) == 2 * PATCHES + PATCHES - 2
    assert bool(torch.isfinite(found.read(0, len(found))).all())


def test_photos_are_chosen_by_seed_each_once_and_no_more_than_patches_can_be_kept() -> None:
    chosen = sample_photos(100, 40, WIDTH, seed=3)
    assert len(set(chosen)) == 40
    assert chosen != sorted(chosen)
    assert chosen == sample_photos(100, 40, WIDTH, seed=3) != sample_photos(100, 40, WIDTH, seed=4)
    assert sorted(sample_photos(30, 1000, WIDTH, seed=0)) == list(range(30))
    wide = 131_072
    few = sample_photos(10_000, 10_000, wide, seed=0)
    assert len(few) == max_photos_to_sample(wide) == 256_000_000 // (4 * wide)
    assert np.unique(few).size == len(few)
