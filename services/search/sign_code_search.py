"""Exact top-k by sign codes: most rows are ruled out by a few bits of their codes.

1. First-level scan: the first bits of every row are compared with the query's. The rows at the
   smallest Hamming distances are estimated from their whole codes; the k-th highest lower bound of
   their scores is a floor of the result.
2. A row passes to the next level while its estimate plus BOUND_DEVIATIONS standard deviations
   reaches the floor: more bits, then all bits, then all bits weighted with the query
   (`shared.codes.sign_codes`).
3. The remaining rows are compared exactly, highest bound first. The floor rises meanwhile, and the
   first row whose bound does not reach it ends the search.

The scores are exact. That no row is missed relies on the bound: an error of more than
BOUND_DEVIATIONS standard deviations of a random rotation has a probability of 1 in 10^9 for a row.
Each row that is compared exactly also shows the error of its estimate: `max_z` is the largest one,
in standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from services.search.chunk_loader import LoadedChunk
from services.search.dense_scan import vector_length
from services.search.exact_rerank import (
    Addresses,
    ExactReranker,
    Indices,
    RowBlocks,
    Scores,
    array_addresses,
    parallel_for,
)
from services.search.kernels import (
    EXCLUDED_DISTANCE,
    PLANES,
    add_hamming_distances,
    hamming_distances,
    weighted_bit_sums,
)
from shared.codes.rotation import Rotation, get_rotation
from shared.codes.sign_codes import (
    WORD_BITS,
    Words,
    encode_signs,
    level_ends,
    pack_bits,
    pack_signs,
)

BOUND_DEVIATIONS = 6.0
SEED_ROWS = 64  # rows, or k, estimated from their whole codes early, to raise the floor
PRUNE_MIN_ROWS = 4 * SEED_ROWS


@dataclass(frozen=True, slots=True, eq=False)
class SignCodeBlocks(RowBlocks):
    """Addresses of the sign codes and rows of n photos in c blocks."""

    level_addresses: Addresses
    """(levels, c): start address of each block's codes of a level."""
    norms: NDArray[np.float32]
    """(n,): |x|_1 of each rotated row; 0 for a row of zeros."""
    zero_rows: Indices
    """Numbers of the rows of zeros."""

    @classmethod
    def of(cls, chunks: Sequence[LoadedChunk]) -> SignCodeBlocks:
        """Collect the sign codes of chunks; ValueError if a chunk has none."""
        codes = [chunk.codes for chunk in chunks if chunk.codes is not None]
        if len(codes) < len(chunks):
            raise ValueError("a chunk has no sign codes")
        norms = np.concatenate([code.norms for code in codes])
        return cls.with_codes(
            chunks,
            level_addresses=np.stack(
                [array_addresses(parts) for parts in zip(*(c.levels for c in codes), strict=True)]
            ),
            norms=norms,
            zero_rows=np.flatnonzero(norms == 0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class SignCodedQuery:
    """A query with its sign bits and quantized numbers."""

    row: NDArray[np.float32]
    """(dimension,) original row of any length but 0."""
    norm: float
    bits: Words
    """(words,): signs of the rotated query."""
    planes: Words
    """(PLANES, words): bit p of the integer, 0 to 2^PLANES - 1, that each number of the rotated
    query is quantized to."""
    low: float
    step: float
    """An integer w stands for low + step * w."""
    total: float
    """Sum of the quantized numbers low + step * w."""
    query_product: float
    """Dot product of the quantized numbers with the rotated unit query; products with the
    quantized numbers are divided by it."""
    quantization_error: float
    """Squared distance of the quantized numbers, divided so, from the rotated unit query."""

    @classmethod
    def of(cls, row: NDArray[np.float32], row_rotation: Rotation) -> SignCodedQuery:
        """Rotate and quantize a (dimension,) row of any length but 0."""
        rotated = row_rotation.rotate(row[np.newaxis])
        low = rotated.min()
        step = (rotated.max() - low) / np.float32(2**PLANES - 1)
        integers = ((rotated - low) * (1 / step) + np.float32(0.5)).astype(np.uint8)
        quantized = integers * step + low
        product = float(np.einsum("ij,ij", quantized, rotated))
        squared_sum = float(np.einsum("ij,ij", quantized, quantized))
        norm = float(vector_length(row))
        plane_bits = (1 << np.arange(PLANES, dtype=np.uint8))[:, np.newaxis]
        return cls(
            row=row,
            norm=norm,
            bits=pack_signs(rotated)[0],
            planes=pack_bits(integers & plane_bits),
            low=float(low),
            step=float(step),
            total=float(quantized.sum()),
            query_product=product / norm,
            quantization_error=max(0.0, squared_sum * norm**2 / product**2 - 1.0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class SignCodeResult:
    """The rows that were compared exactly; no other row can be in the result (see above)."""

    rows: Indices
    scores: Scores
    """Cosines, float64; not sorted."""
    scanned: int
    max_z: float
    """Largest error of an estimate of the compared rows, in standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class FirstLevelScan:
    """Hamming distances of every row to a query, in the bits of the first level."""

    distances: NDArray[np.uint16]
    """(n,); EXCLUDED_DISTANCE for rows outside the mask."""
    counts: NDArray[np.int64]
    """(bits + 1,): number of rows at each distance."""

    def nearest_rows(self, count: int) -> Indices:
        """Return about `count` rows of the smallest distances; more if many distances are equal."""
        max_distance = np.searchsorted(np.cumsum(self.counts), min(count, int(self.counts.sum())))
        return np.flatnonzero(self.distances <= max_distance)[: 4 * count]


def scan_first_level(
    blocks: SignCodeBlocks,
    queries: Sequence[SignCodedQuery],
    row_masks: Sequence[NDArray[np.bool_]],
) -> list[FirstLevelScan]:
    """Compute the first-level distances of several queries in one pass through memory.

    Args:
        blocks: Codes of n rows.
        queries: The queries.
        row_masks: (n,) bool for each query, the rows that may be returned.

    Returns:
        A scan for each query, the same as if it were scanned alone.
    """
    words = int(level_ends(get_rotation(blocks.dimension).padded)[0])
    bits = np.stack([query.bits[:words] for query in queries])
    masks = np.stack(row_masks)
    distances = np.empty((len(queries), len(blocks)), np.uint16)
    counts: list[NDArray[np.int64]] = []

    def scan_range(begin: int, end: int) -> None:
        local_counts = np.zeros((len(queries), words * WORD_BITS + 1), np.int64)
        hamming_distances(
            blocks.level_addresses[0],
            blocks.first_rows,
            masks,
            bits,
            begin,
            end,
            distances,
            local_counts,
        )
        counts.append(local_counts)

    parallel_for(scan_range, len(blocks), 8 * words)
    total = np.sum(counts, axis=0)
    return [
        FirstLevelScan(distance, count) for distance, count in zip(distances, total, strict=True)
    ]


@cache
def compile_kernels() -> None:
    """Compile all kernels of a search, so that no query waits for it."""
    row = np.full(4096, 1 / 64, np.float32)
    codes = encode_signs(row[np.newaxis])
    blocks = SignCodeBlocks(
        dimension=len(row),
        first_rows=np.array([0, 1]),
        row_addresses=array_addresses([row]),
        number_bytes=np.array([row.itemsize]),
        keep_alive=(codes, row),
        level_addresses=np.stack([array_addresses([level]) for level in codes.levels]),
        norms=codes.norms,
        zero_rows=np.empty(0, np.int64),
    )
    query = SignCodedQuery.of(row, get_rotation(len(row)))
    (first,) = scan_first_level(blocks, [query], [np.ones(1, bool)])
    no_rows = np.empty(0, np.int64)
    add_hamming_distances(
        blocks.level_addresses[0], blocks.first_rows, no_rows, query.bits, no_rows
    )
    SignCodeSearch(blocks, query, 1, lambda _: None).search(first)


def hamming_deviation(bits: int, padded: int) -> float:
    """Upper bound of the standard deviation of a cosine estimated from `bits` of `padded` signs.

    (pi / 2) sqrt((1 - (2 / pi)^2 bits / padded) / bits), with the signs of both rows: the signs of
    one rotation are dependent, the more so the more of them are compared.
    """
    return math.pi / 2 * math.sqrt((1 - (2 / math.pi) ** 2 * bits / padded) / bits)


class SignCodeSearch:
    """One query's search, from its first-level scan to the k best rows."""

    def __init__(
        self,
        blocks: SignCodeBlocks,
        query: SignCodedQuery,
        k: int,
        prefetch: Callable[[Indices], None],
    ) -> None:
        """Create a search; `prefetch` is called with rows before they are compared exactly."""
        self._blocks = blocks
        self._query = query
        self._k = k
        self._floor = -math.inf  # score a row has to reach
        self._prefetch = prefetch
        self._padded = get_rotation(blocks.dimension).padded
        self._level_ends = level_ends(self._padded)
        self._estimated = _Estimates.empty()

    def search(self, first: FirstLevelScan) -> SignCodeResult:
        """Prune rows level by level, then compare the remaining ones exactly."""
        seeds = max(SEED_ROWS, self._k)
        if self._k < int(first.counts.sum()):  # otherwise there is no k-th score to reach
            self._raise_floor(first.nearest_rows(seeds))
        rows = np.flatnonzero(first.distances <= self._max_distance(0))
        distances = first.distances[rows].astype(np.int64)
        last = len(self._level_ends) - 1
        for level in range(1, last + 1):
            if level == last and len(rows) <= PRUNE_MIN_ROWS:
                break  # estimating so few rows takes no longer than another level of distances
            self._add_distances(rows, level, distances)
            rows, distances = self._prune(rows, level, distances)
            if len(rows) > 4 * seeds:  # a higher floor saves more than it costs
                nearest = np.argpartition(distances, seeds)[:seeds]
                self._raise_floor(rows[nearest])
                rows, distances = self._prune(rows, level, distances)
        zeros = self._blocks.zero_rows
        if len(zeros):
            rows = np.union1d(rows, zeros[first.distances[zeros] != EXCLUDED_DISTANCE])
        return self._rerank_exactly(self._estimate(rows), first)

    def _max_distance(self, level: int) -> int:
        """Largest Hamming distance at which a row may still reach the floor."""
        bits = int(self._level_ends[level]) * WORD_BITS
        min_cosine = self._floor - BOUND_DEVIATIONS * hamming_deviation(bits, self._padded)
        return int(bits / math.pi * math.acos(min(1.0, max(-1.0, min_cosine))))

    def _add_distances(self, rows: Indices, level: int, distances: Indices) -> None:
        begin, end = int(self._level_ends[level - 1]), int(self._level_ends[level])
        bits = self._query.bits[begin:end]
        codes, first_rows = self._blocks.level_addresses[level], self._blocks.first_rows
        parallel_for(
            lambda i, j: add_hamming_distances(codes, first_rows, rows[i:j], bits, distances[i:j]),
            len(rows),
            8 * len(bits),
        )

    def _prune(self, rows: Indices, level: int, distances: Indices) -> tuple[Indices, Indices]:
        within = distances <= self._max_distance(level)
        return rows[within], distances[within]

    def _raise_floor(self, rows: Indices) -> None:
        """Raise the floor to the k-th highest lower bound of the rows estimated so far."""
        self._estimate(rows)
        lower_bounds = self._estimated.scores - BOUND_DEVIATIONS * self._estimated.deviations
        if len(lower_bounds) >= self._k:
            kth = float(
                np.partition(lower_bounds, len(lower_bounds) - self._k)[len(lower_bounds) - self._k]
            )
            self._floor = max(self._floor, kth)

    def _estimate(self, rows: Indices) -> _Estimates:
        """Return estimated scores of the rows, from their whole codes; estimates are cached."""
        new = rows[~self._estimated.contains(rows)]
        if len(new):
            self._estimated = self._estimated.merge(self._estimate_scores(new))
        return self._estimated.select(rows)

    def _estimate_scores(self, rows: Indices) -> _Estimates:
        query, blocks, ends = self._query, self._blocks, self._level_ends
        sums = np.empty((len(rows), 2), np.int64)
        parallel_for(
            lambda i, j: weighted_bit_sums(
                blocks.level_addresses, blocks.first_rows, rows[i:j], ends, query.planes, sums[i:j]
            ),
            len(rows),
            5 * self._padded // 8,  # five times the work of Hamming distances over as many bytes
        )
        norms = self._blocks.norms[rows].astype(np.float64)
        zero = norms == 0.0
        norms[zero] = 1.0
        signed = 2 * (query.low * sums[:, 0] + query.step * sums[:, 1]) - query.total
        scores = signed / (query.query_product * norms)
        flat = norms**2 / self._padded
        variances = (1 / flat - 1) / (self._padded - 1) + query.quantization_error / (
            flat * self._padded
        )
        deviations = np.sqrt(np.maximum(variances, 0.0))
        scores[zero] = deviations[zero] = 0.0
        return _Estimates(rows, scores, deviations)

    def _rerank_exactly(self, remaining: _Estimates, first: FirstLevelScan) -> SignCodeResult:
        """Compare rows exactly, highest upper bound first."""
        upper_bounds = remaining.scores + BOUND_DEVIATIONS * remaining.deviations
        query = self._query
        reranker = ExactReranker(self._blocks, query.row, query.norm, self._k, self._prefetch)
        rows, scores = reranker.find_best(remaining.rows, upper_bounds, self._floor)
        estimated = remaining.select(rows)
        errors = np.abs(scores - estimated.scores)
        deviations = estimated.deviations
        return SignCodeResult(
            rows=rows,
            scores=scores,
            scanned=int(first.counts.sum()),
            max_z=float(np.max(errors / np.where(deviations > 0, deviations, np.inf), initial=0.0)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Estimates:
    """Estimated scores of rows with their standard deviations; both are 0 for rows of zeros."""

    rows: Indices
    """Row numbers in ascending order."""
    scores: Scores
    deviations: Scores

    @classmethod
    def empty(cls) -> _Estimates:
        return cls(np.empty(0, np.int64), np.empty(0), np.empty(0))

    def merge(self, others: _Estimates) -> _Estimates:
        rows = np.concatenate([self.rows, others.rows])
        order = np.argsort(rows)
        return _Estimates(
            rows[order],
            np.concatenate([self.scores, others.scores])[order],
            np.concatenate([self.deviations, others.deviations])[order],
        )

    def contains(self, rows: Indices) -> NDArray[np.bool_]:
        """Mask of the given rows that have an estimate."""
        if not len(self.rows):
            return np.zeros(len(rows), bool)
        positions = np.minimum(self.rows.searchsorted(rows), len(self.rows) - 1)
        estimated: NDArray[np.bool_] = self.rows[positions] == rows
        return estimated

    def select(self, rows: Indices) -> _Estimates:
        """Estimates of the given rows, which all must have one."""
        positions = self.rows.searchsorted(rows)
        return _Estimates(rows, self.scores[positions], self.deviations[positions])
