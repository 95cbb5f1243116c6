"""GeM and the mean against their formulas, number by number."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from shared.descriptors.aggregators.pooling import average_pooling, gem_pooling

Matrix = NDArray[np.float64]
Aggregate = Callable[[torch.Tensor], torch.Tensor]


def some_features(seed: int) -> torch.Tensor:
    values = np.random.default_rng(seed).standard_normal((3, 40, 16))
    unit = values / np.linalg.norm(values, axis=-1, keepdims=True)
    return torch.from_numpy(unit.astype(np.float32))


def slow_average(patches: Matrix) -> Matrix:
    row = np.array([math.fsum(column) / len(column) for column in patches.T])
    found: Matrix = row / np.linalg.norm(row)
    return found


def slow_gem(patches: Matrix) -> Matrix:
    """(N, D) -> (D,): the cubic mean of what is at least 1e-6, of Radenovic et al."""
    row = np.array(
        [
            (math.fsum(max(value, 1e-6) ** 3 for value in column) / len(column)) ** (1 / 3)
            for column in patches.T
        ]
    )
    found: Matrix = row / np.linalg.norm(row)
    return found


BOTH = pytest.mark.parametrize(
    ("aggregate", "formula"),
    [(average_pooling, slow_average), (gem_pooling, slow_gem)],
    ids=["avg", "gem"],
)


@BOTH
def test_rows_equal_the_formula(aggregate: Aggregate, formula: Callable[[Matrix], Matrix]) -> None:
    features = some_features(1)
    expected = np.stack([formula(photo) for photo in features.double().numpy()])
    np.testing.assert_allclose(aggregate(features), expected, atol=1e-6)


@pytest.mark.parametrize("aggregate", [average_pooling, gem_pooling])
def test_zero_patches_stay_out(aggregate: Aggregate) -> None:
    features = some_features(3)
    blank = torch.cat([torch.zeros(3, 5, 16), features], dim=1)
    np.testing.assert_allclose(aggregate(blank), aggregate(features), atol=1e-6)
    assert aggregate(torch.zeros(1, 4, 16)).tolist() == [[0.0] * 16]
