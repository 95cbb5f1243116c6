"""From pairs of descriptors to one weight for each word, and from there to a weighted query.

    w_k = max(0, (mean of <a_k, b_k> over near pairs - mean over far pairs) / deviation over far)

The distance of two means in units of the noise between them, as signal detection's d' (Green and
Swets 1966): a word that is alike wherever one looks (sky, asphalt) gets 0.

Do weights help: the same queries, asked without and with them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

# Deviations below are rounding: products of words that occur in no far pair are all 0.
MIN_DEVIATION = 1e-9

Rows = NDArray[np.float32]
Float64Array = NDArray[np.float64]


def word_products(rows: Rows, pairs: NDArray[np.int64], words: int) -> Float64Array:
    """(n, words) products <a_k, b_k> of the (n, 2) pairs of (m, words * width) rows.

    Those of a pair add up to its cosine. Takes no more memory than two rows beside the result.
    """
    if not len(pairs):
        return np.empty((0, words))
    blocks = rows.reshape(len(rows), words, -1)
    found = np.empty((len(pairs), words))
    for number, (one, other) in enumerate(pairs.tolist()):
        np.einsum("kw,kw->k", blocks[one], blocks[other], out=found[number], dtype=np.float64)
    return found


@dataclass(frozen=True, slots=True)
class ProductMoments:
    """Sums over the products of so many pairs, word by word; those of two sets of pairs add up."""

    pairs: int
    total: Float64Array
    """(words,)"""
    squares: Float64Array
    """(words,) sums of squares."""

    @classmethod
    def from_products(cls, products: Float64Array) -> ProductMoments:
        """(n, words) products."""
        return cls(len(products), products.sum(axis=0), (products**2).sum(axis=0))

    def __add__(self, other: ProductMoments) -> ProductMoments:
        return ProductMoments(
            self.pairs + other.pairs, self.total + other.total, self.squares + other.squares
        )

    @property
    def mean(self) -> Float64Array:
        found: Float64Array = self.total / self.pairs
        return found

    @property
    def deviation(self) -> Float64Array:
        """Standard deviation over the pairs."""
        found: Float64Array = np.sqrt(np.maximum(0.0, self.squares / self.pairs - self.mean**2))
        return found


@dataclass(frozen=True, slots=True)
class PairStatistics:
    """What pairs of one place (`near`) and of two places (`far`) come to."""

    near: ProductMoments
    far: ProductMoments

    @classmethod
    def from_rows(
        cls, rows: Rows, near: NDArray[np.int64], far: NDArray[np.int64], words: int
    ) -> PairStatistics:
        """Pairs of both kinds, (n, 2) and (m, 2), of (r, words * width) rows."""
        return cls(
            ProductMoments.from_products(word_products(rows, near, words)),
            ProductMoments.from_products(word_products(rows, far, words)),
        )

    def __add__(self, other: PairStatistics) -> PairStatistics:
        return PairStatistics(self.near + other.near, self.far + other.far)

    def weights(self) -> Float64Array:
        """(words,) weights from 0 up. ValueError without pairs of both kinds."""
        if not (self.near.pairs and self.far.pairs):
            raise ValueError(f"{self.near.pairs} near and {self.far.pairs} far pairs teach nothing")
        noise = self.far.deviation
        told = noise > MIN_DEVIATION
        gap = self.near.mean - self.far.mean
        return np.where(told, np.maximum(0.0, gap / np.where(told, noise, 1.0)), 0.0)


def empty_pair_statistics(words: int) -> PairStatistics:
    """What no pairs come to: the sum's beginning."""
    none = ProductMoments(0, np.zeros(words), np.zeros(words))
    return PairStatistics(none, none)


def apply_word_weights(query: NDArray[np.float32], weights: Sequence[float]) -> Float64Array | None:
    """(words * width,) query with its words multiplied, and normalised again; None where no word
    of the query has any weight. ValueError when the query's length is no multiple of the words."""
    if len(query) % len(weights):
        raise ValueError(f"{len(weights)} weights don't fit {len(query)} dimensions")
    blocks = query.astype(np.float64).reshape(len(weights), -1)
    weighted = (blocks * np.asarray(weights, dtype=np.float64)[:, np.newaxis]).ravel()
    norm = float(np.linalg.norm(weighted))
    return None if norm == 0.0 else weighted / norm


SIGNIFICANCE_LEVEL = 0.05


def sign_test_p_value(better: int, worse: int) -> float:
    """How probable so many improvements or more are where weights change nothing for the better.

    `better` queries were right with weights alone, `worse` without them alone. Of those that differ
    each is then a coin's throw: the exact one-sided sign test (McNemar 1947).
    """
    differ = better + worse
    as_good: int = sum(math.comb(differ, n) for n in range(better, differ + 1))
    return float(Fraction(as_good, 2**differ))


def is_significant_improvement(better: int, worse: int) -> bool:
    """More right than without weights, and by more than chance brings in one of twenty cases."""
    return better > worse and sign_test_p_value(better, worse) < SIGNIFICANCE_LEVEL
