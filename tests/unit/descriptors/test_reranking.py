"""Patches match both ways, and the vote asks whether they have moved alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from shared.descriptors import reranking
from shared.descriptors.reranking import (
    VOTE_WEIGHT,
    LocalFeatures,
    mutual_matches,
    rerank_score,
    spatial_vote,
)

pytestmark = pytest.mark.numerics

CPU = torch.device("cpu")
WIDTH, SIDE = 32, 12


def noise(seed: int, count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return normalize(torch.randn(count, WIDTH, generator=generator), dim=-1)


def scene(seed: int = 0, rows: int = SIDE, columns: int = SIDE) -> LocalFeatures:
    """A photo each of whose patches looks different."""
    return LocalFeatures.from_features(noise(seed, rows * columns), (rows, columns))


def shifted(photo: LocalFeatures, down: int, right: int) -> LocalFeatures:
    """The view has moved: what leaves at one side is replaced by something new at the other."""
    moved = np.roll(photo.array, (down, right), axis=(0, 1))
    new = scene(77, *photo.grid).array
    moved[:down], moved[:, :right] = new[:down], new[:, :right]
    return LocalFeatures(moved)


def shuffled(photo: LocalFeatures) -> LocalFeatures:
    """The same patches at other places."""
    order = np.random.default_rng(0).permutation(SIDE * SIDE)
    flat = photo.array.reshape(-1, WIDTH)[order]
    return LocalFeatures(flat.reshape(photo.array.shape))


def vote(query: LocalFeatures, candidate: LocalFeatures) -> float:
    return spatial_vote(query, candidate, CPU)


def test_only_mutual_neighbours_match() -> None:
    x = normalize(torch.tensor([[1.0, 0, 0], [0.9, 0.1, 0], [0, 0, 1]]), dim=-1)
    y = normalize(torch.tensor([[0, 0, 2.0], [1, 0, 0]]), dim=-1)
    of_x, of_y, similarities = mutual_matches(x, y)
    assert of_x.tolist() == [0, 2]
    assert of_y.tolist() == [1, 0]
    assert similarities.tolist() == pytest.approx([1, 1])


def test_patches_without_direction_or_likeness_match_nothing() -> None:
    x = torch.tensor([[0.0, 0.0], [-1.0, 0.0]])
    of_x, of_y, similarities = mutual_matches(x, torch.tensor([[1.0, 0.0]]))
    assert len(of_x) == len(of_y) == len(similarities) == 0
    blank = LocalFeatures(np.zeros((3, 3, WIDTH), np.float16))
    assert vote(blank, scene()) == 0


def test_matches_are_the_same_block_by_block(monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = noise(1, 50), torch.cat([noise(1, 50)[20:40], noise(2, 30)])
    whole = mutual_matches(x, y)
    monkeypatch.setattr(reranking, "BLOCK_ROWS", 7)
    for one, other in zip(whole, mutual_matches(x, y), strict=True):
        torch.testing.assert_close(one, other)
    assert len(whole[0]) >= 20


def test_same_photo_gets_every_vote_and_another_one_hardly_any() -> None:
    assert vote(scene(), scene()) == pytest.approx(1, abs=1e-3)
    assert vote(scene(), scene(1)) < 0.1


def test_same_patches_at_other_places_are_another_place() -> None:
    assert vote(scene(), shuffled(scene())) < 0.2


@pytest.mark.parametrize(("down", "right"), [(0, 3), (2, 0), (2, 3)])
def test_place_seen_from_elsewhere_keeps_the_votes_of_what_both_photos_show(
    down: int, right: int
) -> None:
    seen_twice = (SIDE - down) * (SIDE - right) / SIDE**2
    assert vote(scene(), shifted(scene(), down, right)) == pytest.approx(seen_twice, abs=0.08)


def test_place_seen_from_half_as_far_keeps_its_votes() -> None:
    middle = slice(SIDE // 4, 3 * SIDE // 4)
    near = LocalFeatures(scene().array[middle, middle].repeat(2, axis=0).repeat(2, axis=1))
    assert vote(scene(), near) > 2 * vote(scene(), shuffled(near))


def test_grids_of_two_sizes_are_compared_by_their_places() -> None:
    wide = LocalFeatures(scene().array.repeat(2, axis=1))
    assert wide.grid == (SIDE, 2 * SIDE)
    assert vote(scene(), wide) == pytest.approx(1, abs=0.02)
    assert vote(wide, scene()) == pytest.approx(1, abs=0.02)


def test_rerank_score_is_the_similarity_raised_by_the_vote() -> None:
    assert rerank_score(0.25, scene(), scene(), CPU) == pytest.approx(0.25 + VOTE_WEIGHT, abs=1e-3)
    lone = LocalFeatures.from_features(torch.eye(WIDTH)[:1], (1, 1))
    other = LocalFeatures.from_features(torch.eye(WIDTH)[1:2], (1, 1))
    assert rerank_score(0.25, lone, other, CPU) == 0.25


def test_kept_features_are_what_was_compared() -> None:
    photo = scene(3, 4, 6)
    again = LocalFeatures.decode(photo.encode(), WIDTH)
    assert again.grid == (4, 6)
    assert np.array_equal(again.array, photo.array)
    assert len(photo.encode()) < 4 * 6 * WIDTH * 2 + 200


def test_damaged_features_and_those_of_another_network_are_noticed() -> None:
    cut_off = scene(0, 2, 2).encode()[:-3]
    for data in (b"", b"\x93NUMPY\x01\x00", cut_off, b"PK\x03\x04"):
        with pytest.raises(ValueError, match="not a NumPy array"):
            LocalFeatures.decode(data, WIDTH)
    with pytest.raises(ValueError, match="not float16"):
        LocalFeatures.decode(scene().encode(), WIDTH + 1)
