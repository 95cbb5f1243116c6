"""Computes word weights from pairs of descriptors, applies them to queries, and tests their effect.

    w_k = max(0, (mean of <a_k, b_k> over near pairs - mean over far pairs) / deviation over far)

A weight is the difference of two means in units of the noise, as the sensitivity index d' of signal
detection theory (Green and Swets 1966). A word that looks alike everywhere (sky, asphalt) gets 0.
The effect is tested with a sign test on the same queries with and without weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

# Smaller deviations are rounding errors: a word that is in no far pair has only zero products.
MIN_DEVIATION = 1e-9

Rows = NDArray[np.float32]
Float64Array = NDArray[np.float64]


def word_products(rows: Rows, pairs: NDArray[np.int64], words: int) -> Float64Array:
    """Compute the inner products of the words of pairs of descriptors.

    The products of a pair add up to its cosine. Needs no more memory than two rows in addition to
    the result.

    Args:
        rows: (m, words * width) float32 L2-normalised descriptors.
        pairs: (n, 2) indices into `rows`.

    Returns:
        (n, words) float64.
    """
    if not len(pairs):
        return np.empty((0, words))
    blocks = rows.reshape(len(rows), words, -1)
    products = np.empty((len(pairs), words))
    for index, (a, b) in enumerate(pairs.tolist()):
        np.einsum("kw,kw->k", blocks[a], blocks[b], out=products[index], dtype=np.float64)
    return products


@dataclass(frozen=True, slots=True)
class ProductMoments:
    """Sums of word products over pairs; the sums of two sets of pairs can be added."""

    pairs: int
    """number of pairs"""
    total: Float64Array
    """(words,) sums"""
    squares: Float64Array
    """(words,) sums of squares"""

    @classmethod
    def from_products(cls, products: Float64Array) -> ProductMoments:
        """Sum (n, words) products."""
        return cls(len(products), products.sum(axis=0), (products**2).sum(axis=0))

    def __add__(self, other: ProductMoments) -> ProductMoments:
        return ProductMoments(
            self.pairs + other.pairs, self.total + other.total, self.squares + other.squares
        )

    @property
    def mean(self) -> Float64Array:
        """(words,) means over the pairs."""
        mean: Float64Array = self.total / self.pairs
        return mean

    @property
    def deviation(self) -> Float64Array:
        """(words,) standard deviations over the pairs."""
        deviation: Float64Array = np.sqrt(np.maximum(0.0, self.squares / self.pairs - self.mean**2))
        return deviation


@dataclass(frozen=True, slots=True)
class PairStatistics:
    """Moments of same-place (`near`) and different-place (`far`) pairs."""

    near: ProductMoments
    far: ProductMoments

    @classmethod
    def from_rows(
        cls, rows: Rows, near: NDArray[np.int64], far: NDArray[np.int64], words: int
    ) -> PairStatistics:
        """Compute the statistics of descriptor pairs.

        `near` (n, 2) and `far` (m, 2) hold row numbers of `rows`, (r, words * width).
        """
        return cls(
            ProductMoments.from_products(word_products(rows, near, words)),
            ProductMoments.from_products(word_products(rows, far, words)),
        )

    def __add__(self, other: PairStatistics) -> PairStatistics:
        return PairStatistics(self.near + other.near, self.far + other.far)

    def weights(self) -> Float64Array:
        """Compute the weights, (words,) float64, 0 or more.

        Raises:
            ValueError: there are no near pairs or no far pairs.
        """
        if not (self.near.pairs and self.far.pairs):
            raise ValueError(
                f"Word weights need near and far pairs; there are {self.near.pairs} near and "
                f"{self.far.pairs} far pairs."
            )
        noise = self.far.deviation
        is_informative = noise > MIN_DEVIATION
        gap = self.near.mean - self.far.mean
        return np.where(
            is_informative, np.maximum(0.0, gap / np.where(is_informative, noise, 1.0)), 0.0
        )


def empty_pair_statistics(words: int) -> PairStatistics:
    """Return the statistics of no pairs, the start value of a sum."""
    zero = ProductMoments(0, np.zeros(words), np.zeros(words))
    return PairStatistics(zero, zero)


def apply_word_weights(query: NDArray[np.float32], weights: Sequence[float]) -> Float64Array | None:
    """Multiply the words of a query by their weights and L2-normalise it.

    Args:
        query: (words * width,) descriptor.
        weights: one weight per word.

    Returns:
        (words * width,) float64; None if all words of the query have weight 0.

    Raises:
        ValueError: the dimension is not a multiple of the number of weights.
    """
    if len(query) % len(weights):
        raise ValueError(f"{len(weights)} weights don't fit {len(query)} dimensions")
    blocks = query.astype(np.float64).reshape(len(weights), -1)
    weighted = (blocks * np.asarray(weights, dtype=np.float64)[:, np.newaxis]).ravel()
    norm = float(np.linalg.norm(weighted))
    return None if norm == 0.0 else weighted / norm


SIGNIFICANCE_LEVEL = 0.05


def sign_test_p_value(better: int, worse: int) -> float:
    """Compute the p-value of the exact one-sided sign test (McNemar 1947).

    Under the null hypothesis that weights do not improve recall, each query whose result differs
    is equally likely to be better (correct only with weights) or worse.
    """
    total = better + worse
    at_least_as_good: int = sum(math.comb(total, n) for n in range(better, total + 1))
    return float(Fraction(at_least_as_good, 2**total))


def is_significant_improvement(better: int, worse: int) -> bool:
    """Return whether weights improve recall at `SIGNIFICANCE_LEVEL`."""
    return better > worse and sign_test_p_value(better, worse) < SIGNIFICANCE_LEVEL
