"""Matching: which keypoint of one photo is which of another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared.matching.features import QUANTISATION, LocalFeatures

MIN_COSINE = 0.82  # of a match; that of the authors of XFeat
MAX_BLOCK_PRODUCTS = 1 << 18
"""Larger products of matrices are computed in several threads by OpenBLAS"""

Matches = NDArray[np.intp]
"""(m, 2) numbers of the keypoints in the first and in the second photo"""


def match_keypoints(first: LocalFeatures, second: LocalFeatures) -> Matches:
    """Return the pairs of keypoints that are each other's nearest by cosine similarity.

    Most similar first; each keypoint is in at most one. Their similarity exceeds MIN_COSINE.
    """
    if not len(first.descriptors) or not len(second.descriptors):
        return np.empty((0, 2), dtype=np.intp)
    products = _multiply(first.descriptors, second.descriptors)
    nearest = products.argmax(axis=1)
    numbers = np.arange(len(nearest))
    is_mutual = products.argmax(axis=0)[nearest] == numbers
    cosines = products[numbers, nearest] / QUANTISATION**2
    chosen = np.flatnonzero(is_mutual & (cosines > MIN_COSINE))
    chosen = chosen[np.argsort(-cosines[chosen], kind="stable")]
    return np.column_stack([chosen, nearest[chosen]])


def _multiply(first: NDArray[np.int8], second: NDArray[np.int8]) -> NDArray[np.float32]:
    """Return the (n, m) products of (n, D) and (m, D) rows, exactly: all sums are below 2^24.

    In blocks of one thread each: pairs of photos are matched in several threads, in which the
    threads of OpenBLAS would wait for each other.
    """
    rows = max(1, MAX_BLOCK_PRODUCTS // second.size)
    padded = np.pad(first, ((0, -len(first) % rows), (0, 0))).astype(np.float32)
    blocks = padded.reshape(-1, rows, first.shape[1]) @ np.ascontiguousarray(second.T, np.float32)
    products: NDArray[np.float32] = blocks.reshape(len(padded), len(second))[: len(first)]
    return products
