"""k-means: the same centres from the same seed, and every cluster used."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize

from shared.vision.kmeans import MAX_ITERATIONS, TOLERANCE, iterate, seed_centres
from shared.vision.vlad import assign


def some_points(seed: int, count: int, width: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return normalize(torch.randn(count, width, generator=generator), dim=1)


def run(points: torch.Tensor, centres: torch.Tensor, most: int) -> tuple[torch.Tensor, int]:
    """Up to `most` steps, until the centres have settled."""
    for done in range(1, most + 1):
        centres, movement = iterate(points, centres)
        if movement <= TOLERANCE:
            return centres, done
    return centres, most


def test_one_seed_gives_one_result() -> None:
    points = some_points(1, 300, 6)
    first, _ = run(points, seed_centres(points, 7, seed=5), MAX_ITERATIONS)
    again, _ = run(points, seed_centres(points, 7, seed=5), MAX_ITERATIONS)
    other, _ = run(points, seed_centres(points, 7, seed=6), MAX_ITERATIONS)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_iterations_cut_into_pieces_give_the_same_centres() -> None:
    points = some_points(2, 400, 8)
    begin = seed_centres(points, 9, seed=0)
    at_once, steps = run(points, begin, MAX_ITERATIONS)
    assert steps > 3, "the example should need several steps"
    pieces, left = begin, steps
    while left:
        piece = min(2, left)
        # What is kept between two slices goes through a NumPy file.
        pieces = torch.from_numpy(pieces.numpy().copy())
        for _ in range(piece):
            pieces, _ = iterate(points, pieces)
        left -= piece
    assert torch.equal(pieces, at_once)


def test_seeds_are_points_and_all_different() -> None:
    points = some_points(3, 50, 4)
    seeds = seed_centres(points, 20, seed=1)
    rows = {tuple(point.tolist()) for point in points}
    assert {tuple(seed.tolist()) for seed in seeds} <= rows
    assert len({tuple(seed.tolist()) for seed in seeds}) == 20


def test_separated_clusters_are_found() -> None:
    generator = torch.Generator().manual_seed(4)
    truth = torch.eye(5)
    noise = 0.05 * torch.randn(5, 40, 5, generator=generator)
    points = normalize((truth[:, None] + noise).flatten(0, 1), dim=1)
    centres, _ = run(points, seed_centres(points, 5, seed=0), MAX_ITERATIONS)
    labels = assign(points, centres).reshape(5, 40)
    assert all(len(set(group.tolist())) == 1 for group in labels)
    assert len(set(labels[:, 0].tolist())) == 5


def test_centres_are_plain_means_and_not_normalised_again() -> None:
    points = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    moved, movement = iterate(points, torch.tensor([[0.7, 0.7], [-1.0, 0.0]]))
    assert moved.tolist() == [[0.5, 0.5], [-1.0, 0.0]]
    assert movement == pytest.approx(2 * 0.2**2)


def test_empty_cluster_takes_the_point_that_its_own_centre_describes_worst() -> None:
    points = normalize(torch.tensor([[1.0, 0.0], [1.0, 0.1], [1.0, -0.1], [0.6, 0.8]]), dim=1)
    nobody = torch.tensor([[1.0, 0.0], [-1.0, 0.0]])
    moved, _ = iterate(points, nobody)
    assert torch.equal(moved[1], points[3])


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), clusters=st.integers(1, 12), copies=st.integers(1, 4))
def test_no_cluster_is_left_empty_when_there_are_enough_distinct_points(
    seed: int, clusters: int, copies: int
) -> None:
    points = some_points(seed, 3 * clusters, 4).repeat(copies, 1)
    # The worst start: every centre the same, so that all but one are empty.
    centres, _ = run(points, points[:1].repeat(clusters, 1), MAX_ITERATIONS)
    assert len(set(assign(points, centres).tolist())) == clusters


def test_points_that_are_all_equal_give_finite_centres() -> None:
    points = normalize(torch.ones(30, 4), dim=1)
    centres, _ = run(points, seed_centres(points, 5, seed=0), MAX_ITERATIONS)
    assert centres.shape == (5, 4)
    assert bool(torch.isfinite(centres).all())


def test_more_clusters_than_points_do_not_crash() -> None:
    points = some_points(9, 3, 4)
    centres, _ = run(points, seed_centres(points, 3, seed=0), MAX_ITERATIONS)
    assert bool(torch.isfinite(centres).all())
    assert seed_centres(points, 6, seed=0).shape == (6, 4)
