"""Exact top-k by sign codes: most rows are told apart from the best by a few of their bits.

1. The first bits of every row are compared with the query's. The rows that look best are compared
   exactly: their k-th score is a floor for the answer.
2. A row goes on to the next level while its estimate, plus BOUND standard deviations, reaches the
   floor: more bits, then all bits, then all bits weighted with the query
   (`shared.codes.sign_codes`).
3. What is left is compared exactly, best estimate first. The floor rises on the way, and the first
   row whose bound does not reach it ends the search.

The scores are exact. That none is missed rests on the bound: an error of more than BOUND standard
deviations of a random rotation, 1 in 10^9 for a row. Each row that is compared exactly also shows
how far off its estimates were: `max_z`, in standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from services.search.chunk_loader import LoadedChunk
from services.search.exact_rerank import (
    Addresses,
    ExactReranker,
    Indices,
    RowBlocks,
    Scores,
    SearchBudget,
    array_addresses,
    parallel_for,
)
from services.search.kernels import (
    EXCLUDED_DISTANCE,
    PLANES,
    add_hamming_distances,
    hamming_distances,
    quantize_to_bit_planes,
    squared_norm,
    weighted_bit_sums,
)
from shared.codes.rotation import Rotation, get_rotation
from shared.codes.sign_codes import WORD_BITS, Words, encode_signs, level_ends

BOUND_DEVIATIONS = 6.0
SEED_ROWS = 64  # rows whose whole codes are looked at early, for a floor
PRUNE_MIN_ROWS = 4 * SEED_ROWS


@dataclass(frozen=True, slots=True, eq=False)
class SignCodeBlocks(RowBlocks):
    """Where the sign codes and the rows of n photos lie, in c blocks."""

    level_addresses: Addresses
    """(levels, c): where each block's codes of a level begin."""
    norms: NDArray[np.float32]
    """(n,): |x|_1 of each rotated row; 0 for a row of zeros."""
    zero_rows: Indices
    """The rows of zeros."""

    @classmethod
    def of(cls, chunks: Sequence[LoadedChunk]) -> SignCodeBlocks:
        """Those of chunks that have their codes."""
        codes = [chunk.codes for chunk in chunks if chunk.codes is not None]
        if len(codes) < len(chunks):
            raise ValueError("a chunk has no codes")
        rows = RowBlocks.of(chunks)
        norms = np.concatenate([code.norms for code in codes])
        return cls(
            dimension=rows.dimension,
            first_rows=rows.first_rows,
            row_addresses=rows.row_addresses,
            keep_alive=rows.keep_alive,
            level_addresses=np.stack(
                [array_addresses(parts) for parts in zip(*(c.levels for c in codes), strict=True)]
            ),
            norms=norms,
            zero_rows=np.flatnonzero(norms == 0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class SignCodedQuery:
    """A query as the codes need it."""

    row: NDArray[np.float32]
    """(dimension,) as it was asked, of any length but 0."""
    norm: float
    bits: Words
    """(words,)"""
    planes: Words
    """(PLANES, words): bit p of the whole number, 0 to 2^PLANES - 1, that each number of the
    rotated query is brought to."""
    low: float
    step: float
    """A whole number w stands for low + step * w."""
    total: float
    """The sum of what they stand for."""
    query_product: float
    """Their product with the rotated unit query, by which products with them are divided."""
    quantization_error: float
    """How far off they are, squared, once they are divided so."""

    @classmethod
    def of(cls, row: NDArray[np.float32], row_rotation: Rotation) -> SignCodedQuery:
        rotated = row_rotation.rotate(row[np.newaxis])[0]
        bits = np.empty(row_rotation.padded // WORD_BITS, np.uint64)
        planes = np.empty((PLANES, len(bits)), np.uint64)
        low, step, total, product, square = quantize_to_bit_planes(rotated, bits, planes)
        norm = math.sqrt(squared_norm(row))
        return cls(
            row=row,
            norm=norm,
            bits=bits,
            planes=planes,
            low=low,
            step=step,
            total=total,
            query_product=product / norm,
            quantization_error=max(0.0, square * norm**2 / product**2 - 1.0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class SignCodeResult:
    """Every row that was compared exactly, and what is known of the others."""

    rows: Indices
    scores: Scores
    """Cosines, float64; not sorted."""
    scanned: int
    max_z: float
    """The largest error of an estimate, in its standard deviations, of the rows compared."""
    unseen_bound: float
    """No other row reaches more than this (up to BOUND); -inf where none can matter."""

    @property
    def is_complete(self) -> bool:
        """Whether it did not end early."""
        return self.unseen_bound == -math.inf

    @classmethod
    def interrupted(cls, first: FirstLevelScan, unseen: float) -> SignCodeResult:
        """Given up before any row was compared exactly."""
        scanned = int(first.counts.sum())
        return cls(np.empty(0, np.int64), np.empty(0), scanned, 0.0, unseen)


@dataclass(frozen=True, slots=True, eq=False)
class FirstLevelScan:
    """How many of the first bits of every row differ from a query's."""

    distances: NDArray[np.uint16]
    """(n,); NOT_ASKED for rows that were not asked for."""
    counts: NDArray[np.int64]
    """(bits + 1,): how many rows have each distance."""

    def nearest_rows(self, wanted: int) -> Indices:
        """About `wanted` rows of the smallest distances: more where many are equal."""
        reached = np.searchsorted(np.cumsum(self.counts), min(wanted, int(self.counts.sum())))
        return np.flatnonzero(self.distances <= reached)[: 4 * wanted]


def scan_first_level(
    blocks: SignCodeBlocks,
    queries: Sequence[SignCodedQuery],
    row_masks: Sequence[NDArray[np.bool_]],
) -> list[FirstLevelScan]:
    """Compare the first bits of the rows that each query asks for, (n,) bool: one way through
    memory for all queries, each of which sees what it would see alone."""
    words = int(level_ends(get_rotation(blocks.dimension).padded)[0])
    bits = np.stack([query.bits[:words] for query in queries])
    masks = np.stack(row_masks)
    found = np.empty((len(queries), len(blocks)), np.uint16)
    counts: list[NDArray[np.int64]] = []

    def part(begin: int, end: int) -> None:
        own = np.zeros((len(queries), words * WORD_BITS + 1), np.int64)
        hamming_distances(
            blocks.level_addresses[0], blocks.first_rows, masks, bits, begin, end, found, own
        )
        counts.append(own)

    parallel_for(part, len(blocks), 8 * words)
    total = np.sum(counts, axis=0)
    return [FirstLevelScan(distance, count) for distance, count in zip(found, total, strict=True)]


@cache
def compile_kernels() -> None:
    """Have everything compiled that a search calls, so that no query waits for it."""
    row = np.full(4096, 1 / 64, np.float32)
    codes = encode_signs(row[np.newaxis])
    blocks = SignCodeBlocks(
        dimension=len(row),
        first_rows=np.array([0, 1]),
        row_addresses=array_addresses([row]),
        keep_alive=(codes, row),
        level_addresses=np.stack([array_addresses([level]) for level in codes.levels]),
        norms=codes.norms,
        zero_rows=np.empty(0, np.int64),
    )
    query = SignCodedQuery.of(row, get_rotation(len(row)))
    (first,) = scan_first_level(blocks, [query], [np.ones(1, bool)])
    none = np.empty(0, np.int64)
    add_hamming_distances(blocks.level_addresses[0], blocks.first_rows, none, query.bits, none)
    SignCodeSearch(blocks, query, 1, None, lambda _: None).search(first, SearchBudget())


def hamming_deviation(bits: int, padded: int) -> float:
    """Standard deviation, at most, of the cosine from `bits` of `padded` signs on both sides.

    (pi / 2) sqrt((1 - (2 / pi)^2 bits / padded) / bits): the signs of one rotation know of each
    other, the more of them are compared.
    """
    return math.pi / 2 * math.sqrt((1 - (2 / math.pi) ** 2 * bits / padded) / bits)


class SignCodeSearch:
    """From a glance at every row to the k best."""

    def __init__(
        self,
        blocks: SignCodeBlocks,
        query: SignCodedQuery,
        k: int,
        min_score: float | None,
        prefetch: Callable[[Indices], None],
    ) -> None:
        """`min_score`: rows below this score are not wanted. `prefetch` is told of rows before they
        are compared exactly."""
        self._blocks = blocks
        self._query = query
        self._k = k
        self._floor = (
            -math.inf if min_score is None else min_score
        )  # what a row has to reach to matter
        self._prefetch = prefetch
        self._padded = get_rotation(blocks.dimension).padded
        self._level_ends = level_ends(self._padded)
        self._estimated = _Estimates.empty()

    def search(self, first: FirstLevelScan, budget: SearchBudget) -> SignCodeResult:
        """Go through the levels with what the first one has shown."""
        if self._k < int(first.counts.sum()):  # else every row is wanted that is good enough
            self._raise_floor(first.nearest_rows(max(SEED_ROWS, self._k)))
        rows = np.flatnonzero(first.distances <= self._max_distance(0))
        differ = first.distances[rows].astype(np.int64)
        last = len(self._level_ends) - 1
        for level in range(1, last + 1):
            if level == last and len(rows) <= PRUNE_MIN_ROWS:
                break  # weighing all their bits takes no longer than counting the rest of them
            self._add_distances(rows, level, differ)
            rows, differ = self._prune(rows, level, differ)
            if len(rows) > PRUNE_MIN_ROWS:  # a better floor spares more than it costs
                best = np.argpartition(differ, SEED_ROWS)[:SEED_ROWS]
                self._raise_floor(rows[best])
                rows, differ = self._prune(rows, level, differ)
            if budget.is_exhausted(0):
                return SignCodeResult.interrupted(first, self._max_score(level, differ))
        zeros = self._blocks.zero_rows
        if len(zeros):
            rows = np.union1d(rows, zeros[first.distances[zeros] != EXCLUDED_DISTANCE])
        return self._rerank_exactly(self._estimate(rows), first, budget)

    def _max_distance(self, level: int) -> int:
        """The largest number of differing bits that may still be a row above the floor."""
        bits = int(self._level_ends[level]) * WORD_BITS
        least = self._floor - BOUND_DEVIATIONS * hamming_deviation(bits, self._padded)
        return int(bits / math.pi * math.acos(min(1.0, max(-1.0, least))))

    def _max_score(self, level: int, differ: Indices) -> float:
        """The most that rows with so many differing bits can score."""
        if not len(differ):
            return -math.inf
        bits = int(self._level_ends[level]) * WORD_BITS
        nearest = math.cos(math.pi * int(differ.min()) / bits)
        return nearest + BOUND_DEVIATIONS * hamming_deviation(bits, self._padded)

    def _add_distances(self, rows: Indices, level: int, differ: Indices) -> None:
        """Add the bits of a level that differ."""
        begin, end = int(self._level_ends[level - 1]), int(self._level_ends[level])
        bits = self._query.bits[begin:end]
        codes, first = self._blocks.level_addresses[level], self._blocks.first_rows
        parallel_for(
            lambda i, j: add_hamming_distances(codes, first, rows[i:j], bits, differ[i:j]),
            len(rows),
            8 * len(bits),
        )

    def _prune(self, rows: Indices, level: int, differ: Indices) -> tuple[Indices, Indices]:
        kept = differ <= self._max_distance(level)
        return rows[kept], differ[kept]

    def _raise_floor(self, rows: Indices) -> None:
        """To what the k-th best of the rows estimated so far reaches at least."""
        self._estimate(rows)
        least = self._estimated.scores - BOUND_DEVIATIONS * self._estimated.deviations
        if len(least) >= self._k:
            kth = float(np.partition(least, len(least) - self._k)[len(least) - self._k])
            self._floor = max(self._floor, kth)

    def _estimate(self, rows: Indices) -> _Estimates:
        """The scores of these rows, estimated from their whole codes, and kept."""
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
            5 * self._padded // 8,  # five times the work of a glance at as many bytes
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

    def _rerank_exactly(
        self, left: _Estimates, first: FirstLevelScan, budget: SearchBudget
    ) -> SignCodeResult:
        """Compare what may matter exactly, best first."""
        reach = left.scores + BOUND_DEVIATIONS * left.deviations
        query = self._query
        rerank = ExactReranker(self._blocks, query.row, query.norm, self._k, self._prefetch)
        compared = rerank.find_best(left.rows, reach, self._floor, budget)
        estimated = left.select(compared.rows)
        errors = np.abs(compared.scores - estimated.scores)
        sure = estimated.deviations
        return SignCodeResult(
            rows=compared.rows,
            scores=compared.scores,
            scanned=int(first.counts.sum()),
            max_z=float(np.max(errors / np.where(sure > 0, sure, np.inf), initial=0.0)),
            unseen_bound=compared.unseen_bound,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Estimates:
    """Estimated scores of rows, with their standard deviations; 0 and 0 for rows of zeros."""

    rows: Indices
    """Rising."""
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
        """Which of any rows are among these."""
        if not len(self.rows):
            return np.zeros(len(rows), bool)
        at = np.minimum(self.rows.searchsorted(rows), len(self.rows) - 1)
        found: NDArray[np.bool_] = self.rows[at] == rows
        return found

    def select(self, rows: Indices) -> _Estimates:
        """Of some of these rows."""
        at = self.rows.searchsorted(rows)
        return _Estimates(rows, self.scores[at], self.deviations[at])
