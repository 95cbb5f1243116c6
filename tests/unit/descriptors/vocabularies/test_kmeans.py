"""The steps of k-means: seeds, mini-batches, passes, and what becomes of empty clusters."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.descriptors.aggregators.clustering import assign_clusters
from shared.descriptors.kmeans import KMeansPass, choose_seeds
from tests.unit.descriptors.vocabularies.points import unit_points

pytestmark = pytest.mark.numerics


def walk(points: torch.Tensor, centres: torch.Tensor, batch: int) -> KMeansPass:
    """A pass of Lloyd's, in batches."""
    one = KMeansPass.begin(centres)
    for part in torch.split(points, batch):
        one.accumulate(part, centres)
    return one


def test_seeds_are_points_and_all_different_while_there_are_enough() -> None:
    points = unit_points(3, 50, 4)
    seeds = choose_seeds(points, 20, seed=1)
    rows = {tuple(point.tolist()) for point in points}
    assert {tuple(seed.tolist()) for seed in seeds} <= rows
    assert len({tuple(seed.tolist()) for seed in seeds}) == 20
    assert not torch.equal(seeds, choose_seeds(points, 20, seed=2))
    assert choose_seeds(unit_points(9, 3, 4), 6, seed=0).shape == (6, 4)


def test_a_pass_ends_with_plain_means_that_are_not_normalised_again() -> None:
    points = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    centres = torch.tensor([[0.7, 0.7], [-1.0, 0.0]])
    one = walk(points, centres, batch=2)
    assert one.end(centres).tolist() == [[0.5, 0.5], [-1.0, 0.0]]
    assert one.counts.tolist() == [2, 1]
    assert float(one.similarity) == pytest.approx(2 * 0.5**0.5 + 1)


@pytest.mark.parametrize("batch", [1, 7, 64, 1000])
def test_a_pass_is_the_same_in_batches_of_any_size(batch: int) -> None:
    points = unit_points(5, 300, 6)
    centres = torch.cat([points[:8], torch.full((1, 6), -9.0)])
    whole = walk(points, centres, batch=300)
    cut = walk(points, centres, batch=batch)
    assert torch.equal(cut.counts, whole.counts)
    torch.testing.assert_close(cut.end(centres), whole.end(centres))
    expected = torch.stack(
        [points[assign_clusters(points, centres) == k].mean(dim=0) for k in range(len(centres) - 1)]
    )
    torch.testing.assert_close(cut.end(centres)[:-1], expected)


def test_an_empty_cluster_takes_the_point_that_its_own_centre_describes_worst() -> None:
    points = torch.nn.functional.normalize(
        torch.tensor([[1.0, 0.0], [1.0, 0.1], [0.6, 0.8], [1.0, -0.1]]), dim=1
    )
    nobody = torch.tensor([[1.0, 0.0], [-1.0, 0.0]])
    for batch in (1, 2, 4):
        assert torch.equal(walk(points, nobody, batch).end(nobody)[1], points[2])


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), clusters=st.integers(1, 12), copies=st.integers(1, 4))
def test_no_cluster_is_left_empty_when_there_are_enough_distinct_points(
    seed: int, clusters: int, copies: int
) -> None:
    points = unit_points(seed, 3 * clusters, 4).repeat(copies, 1)
    # The worst start: every centre the same, so that all but one are empty.
    centres = points[:1].repeat(clusters, 1)
    for _ in range(60):
        centres = walk(points, centres, batch=25).end(centres)
    assert len(set(assign_clusters(points, centres).tolist())) == clusters
