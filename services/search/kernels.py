"""Compiled kernels of the search: Hamming distances and products of rows.

Rows lie in many arrays, some of them memory-mapped files, so the kernels take addresses; the caller
keeps the memory alive. The kernels release the GIL.

Parameters that most kernels have:

* `block_addresses` (c,): start address of each block's rows;
* `first_rows` (c + 1,): number of each block's first row; the last is the number of rows.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from shared.codes.jit import REORDERED_FASTMATH, numba_jit

EXCLUDED_DISTANCE = 65_535  # more than any distance
PLANES = 4  # `weighted_bit_sums` is written for exactly 4

Words = NDArray[np.uint64]
Addresses = NDArray[np.uint64]


@intrinsic
def _popcount(_typing: Any, value: types.Type) -> Any:
    """Number of set bits of a uint64."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


def _pointer_to(element: types.Type) -> Any:
    @intrinsic
    def pointer(_typing: Any, _address: types.Type) -> Any:
        """Convert an address to a pointer."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            kind = context.get_value_type(signature.return_type)
            return builder.inttoptr(arguments[0], kind)

        return types.CPointer(element)(types.uint64), generate

    return pointer


@intrinsic
def _float16_value(_typing: Any, bits: types.Type) -> Any:
    """Convert the bits of a float16, a uint16, to float32; numba has no float16 on CPUs."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.fpext(builder.bitcast(arguments[0], ir.HalfType()), ir.FloatType())

    return types.float32(types.uint16), generate


_words_at = _pointer_to(types.uint64)
_floats_at = _pointer_to(types.float32)
_float16_bits_at = _pointer_to(types.uint16)


@numba_jit(REORDERED_FASTMATH)
def hamming_distances(
    block_addresses: Addresses,
    first_rows: NDArray[np.int64],
    row_masks: NDArray[np.bool_],
    queries: Words,
    begin: int,
    end: int,
    out: NDArray[np.uint16],
    counts: NDArray[np.int64],
) -> None:
    """Hamming distances of q queries to the rows `begin` to `end`, numbered across all blocks.

    Args:
        block_addresses: (c,) addresses of the blocks' codes, each row as long as a query.
        first_rows: (c + 1,) number of each block's first row.
        row_masks: (q, rows) bool; other rows are skipped and get EXCLUDED_DISTANCE.
        queries: (q, words) uint64.
        begin: First row.
        end: One past the last row.
        out: (q, rows) uint16, the distances.
        counts: (q, bits + 1) int64, incremented by the number of rows at each distance.
    """
    words = queries.shape[1]
    block = np.searchsorted(first_rows, begin, side="right") - 1
    while begin < end:
        block_end = min(end, first_rows[block + 1])
        codes = nb.carray(
            _words_at(block_addresses[block]), (first_rows[block + 1] - first_rows[block], words)
        )
        for row in range(begin, block_end):
            code = codes[row - first_rows[block]]
            for query_index in range(queries.shape[0]):
                if not row_masks[query_index, row]:
                    out[query_index, row] = EXCLUDED_DISTANCE
                    continue
                query = queries[query_index]
                distance = np.uint64(0)
                for i in range(words):
                    distance += _popcount(code[i] ^ query[i])
                out[query_index, row] = distance
                counts[query_index, distance] += 1
        begin = block_end
        block += 1


@numba_jit(REORDERED_FASTMATH)
def _address(
    block_addresses: Addresses, first_rows: NDArray[np.int64], row: int, row_bytes: int
) -> np.uint64:
    block = np.searchsorted(first_rows, row, side="right") - 1
    return block_addresses[block] + np.uint64((row - first_rows[block]) * row_bytes)


@numba_jit(REORDERED_FASTMATH)
def add_hamming_distances(
    block_addresses: Addresses,
    first_rows: NDArray[np.int64],
    rows: NDArray[np.int64],
    query: Words,
    out: NDArray[np.int64],
) -> None:
    """Add the Hamming distance between the query and the code of each row to `out`, (n,).

    Args:
        block_addresses: (c,) addresses of the blocks' codes, each row as long as the query.
        first_rows: (c + 1,) number of each block's first row.
        rows: (n,) row numbers.
        query: (words,) uint64.
        out: (n,) int64.
    """
    words = query.shape[0]
    for index in range(rows.shape[0]):
        address = _address(block_addresses, first_rows, rows[index], 8 * words)
        code = nb.carray(_words_at(address), (words,))
        distance = np.uint64(0)
        for i in range(words):
            distance += _popcount(code[i] ^ query[i])
        out[index] += np.int64(distance)


@numba_jit(REORDERED_FASTMATH)
def weighted_bit_sums(
    level_addresses: Addresses,
    first_rows: NDArray[np.int64],
    rows: NDArray[np.int64],
    level_ends: NDArray[np.int64],
    planes: Words,
    out: NDArray[np.int64],
) -> None:
    """Sums over the set bits of each row's code, unweighted and weighted with the query.

    Args:
        level_addresses: (levels, c) addresses of the blocks' codes of each level.
        first_rows: (c + 1,) number of each block's first row.
        rows: (n,) row numbers.
        level_ends: (levels,) word at which each level ends.
        planes: (PLANES, words) bits of the query's quantized numbers, least significant plane
            first.
        out: (n, 2) int64: number of set bits, and sum of the query's quantized numbers at set bits.
    """
    for index in range(rows.shape[0]):
        ones = units = twos = fours = eights = np.uint64(0)
        begin = np.int64(0)
        for level in range(level_ends.shape[0]):
            words = level_ends[level] - begin
            address = _address(level_addresses[level], first_rows, rows[index], 8 * words)
            code = nb.carray(_words_at(address), (words,))
            weights = planes[:, begin : level_ends[level]]
            one, two, four, eight = weights[0], weights[1], weights[2], weights[3]
            for i in range(words):
                word = code[i]
                ones += _popcount(word)
                units += _popcount(word & one[i])
                twos += _popcount(word & two[i])
                fours += _popcount(word & four[i])
                eights += _popcount(word & eight[i])
            begin = level_ends[level]
        out[index, 0] = np.int64(ones)
        out[index, 1] = np.int64(units + 2 * twos + 4 * fours + 8 * eights)


@numba_jit(REORDERED_FASTMATH)
def row_products(
    block_addresses: Addresses,
    first_rows: NDArray[np.int64],
    number_bytes: NDArray[np.int64],
    rows: NDArray[np.int64],
    query: NDArray[np.float32],
    out: NDArray[np.float32] | NDArray[np.float64],
) -> None:
    """Dot products of float32 or float16 rows with the query, summed in the type of `out`.

    Each product is exact in float64. The sums of equal rows are equal.

    Args:
        block_addresses: (c,) addresses of the blocks' rows.
        first_rows: (c + 1,) number of each block's first row.
        number_bytes: (c,) bytes of a number of each block's rows: 4 for float32, 2 for float16.
        rows: (n,) row numbers.
        query: (dimension,) float32.
        out: (n,) float32 or float64.
    """
    number = out.dtype.type
    for index in range(rows.shape[0]):
        block = np.searchsorted(first_rows, rows[index], side="right") - 1
        row_bytes = number_bytes[block] * query.shape[0]
        address = block_addresses[block] + np.uint64((rows[index] - first_rows[block]) * row_bytes)
        total = number(0)
        if number_bytes[block] == 2:
            halves = nb.carray(_float16_bits_at(address), query.shape)
            for i in range(query.shape[0]):
                total += number(_float16_value(halves[i])) * number(query[i])
        else:
            row = nb.carray(_floats_at(address), query.shape)
            for i in range(query.shape[0]):
                total += number(row[i]) * number(query[i])
        out[index] = total
