"""The compiled loops of a search: over codes, and over rows, wherever in memory they lie.

Rows lie in many arrays, some of them files mapped into memory; so the loops take addresses. Who
calls keeps the arrays alive. They hold no lock of the interpreter.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from shared.codes.jit import REORDERED_FASTMATH, numba_jit

EXCLUDED_DISTANCE = 65_535  # more than any distance
INT32_SAFE_TERMS = 1024  # so many products of a byte and 15 bits add up to less than 2^31
ROUNDING = 1e-9  # more than what float64 loses of a score anywhere: 2^-53 for each of 100,000 terms
PLANES = 4  # `weighted_bit_sums` is written for so many
LOW_BIT_OF_EACH_BYTE = np.uint64(0x0101010101010101)
BIT_GATHER_FACTOR = np.uint64(0x0102040810204080)

Words = NDArray[np.uint64]
Addresses = NDArray[np.uint64]


@intrinsic
def _popcount(_typing: Any, value: types.Type) -> Any:
    """The number of ones of a uint64."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


def _pointer_to(element: types.Type) -> Any:
    @intrinsic
    def pointer(_typing: Any, _address: types.Type) -> Any:
        """The address as a pointer."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            kind = context.get_value_type(signature.return_type)
            return builder.inttoptr(arguments[0], kind)

        return types.CPointer(element)(types.uint64), generate

    return pointer


_words_at = _pointer_to(types.uint64)
_floats_at = _pointer_to(types.float32)
_bytes_at = _pointer_to(types.int8)


@numba_jit(REORDERED_FASTMATH)
def hamming_distances(
    blocks: Addresses,
    first: NDArray[np.int64],
    row_masks: NDArray[np.bool_],
    queries: Words,
    begin: int,
    end: int,
    out: NDArray[np.uint16],
    counts: NDArray[np.int64],
) -> None:
    """How many bits of q queries differ from the rows `begin` to `end` of all blocks together.

    blocks (c,): where each block's codes begin, rows of the queries' length one after the other.
    first (c + 1,): the number of each block's first row. asked (q, rows): the others are passed
    over, and get NOT_ASKED. queries (q, words). out (q, rows). counts (q, bits + 1): how many rows
    have each distance, added to what is there.
    """
    words = queries.shape[1]
    block = np.searchsorted(first, begin, side="right") - 1
    while begin < end:
        upto = min(end, first[block + 1])
        codes = nb.carray(_words_at(blocks[block]), (first[block + 1] - first[block], words))
        for row in range(begin, upto):
            code = codes[row - first[block]]
            for number in range(queries.shape[0]):
                if not row_masks[number, row]:
                    out[number, row] = EXCLUDED_DISTANCE
                    continue
                query = queries[number]
                differ = np.uint64(0)
                for i in range(words):
                    differ += _popcount(code[i] ^ query[i])
                out[number, row] = differ
                counts[number, differ] += 1
        begin = upto
        block += 1


@numba_jit(REORDERED_FASTMATH)
def _address(begins: Addresses, first: NDArray[np.int64], row: int, row_bytes: int) -> np.uint64:
    """Where a row lies: blocks begin at `begins` (c,), with the rows from `first` (c + 1,) on."""
    block = np.searchsorted(first, row, side="right") - 1
    return begins[block] + np.uint64((row - first[block]) * row_bytes)


@numba_jit(REORDERED_FASTMATH)
def int8_product(row: NDArray[np.int8], query: NDArray[np.int16]) -> np.int64:
    """The product of whole numbers of at most 127 and 127 * 128 + 63: exact."""
    total = np.int64(0)
    for begin in range(0, query.shape[0], INT32_SAFE_TERMS):
        some, asked = row[begin : begin + INT32_SAFE_TERMS], query[begin : begin + INT32_SAFE_TERMS]
        part = np.int32(0)
        for j in range(asked.shape[0]):
            part = np.int32(part + np.int32(some[j]) * np.int32(asked[j]))
        total += np.int64(part)
    return total


@numba_jit(REORDERED_FASTMATH)
def rows_above_floor(
    blocks: Addresses,
    first: NDArray[np.int64],
    row_mask: NDArray[np.bool_],
    row_params: NDArray[np.float32],
    query: NDArray[np.int16],
    query_params: tuple[float, float, float],
    begin: int,
    end: int,
    best_scores_heap: NDArray[np.float64],
    rows: NDArray[np.int64],
    upper_bounds: NDArray[np.float64],
    count: int,
) -> int:
    """Of the rows `begin` to `end` of all blocks together, those that may reach the floor.

    blocks (c,): where each block's int8 numbers begin, rows of the query's length one after the
    other. first (c + 1,): the number of each block's first row. asked (rows,): the others are
    passed over. figures (3, rows): scale, error and length of each row; query_figures: scale and
    error of the query, and the lowest floor there is. least (k,): a heap, the least first, of the
    highest scores that rows have for certain; the floor is its least. Who passes is written to
    `rows`, and to `upper_bounds` what it scores at most, from place `count` on; returns the
    next place.
    """
    words = query.shape[0]
    scale, error, lowest = query_params
    floor = max(lowest, best_scores_heap[0])
    block = np.searchsorted(first, begin, side="right") - 1
    while begin < end:
        upto = min(end, first[block + 1])
        numbers = nb.carray(_bytes_at(blocks[block]), (first[block + 1] - first[block], words))
        for row in range(begin, upto):
            if not row_mask[row]:
                continue
            whole = int8_product(numbers[row - first[block]], query)
            score = np.float64(row_params[0, row]) * scale * np.float64(whole)
            bound = row_params[1, row] + row_params[2, row] * error + ROUNDING
            if score + bound >= floor:
                rows[count], upper_bounds[count] = row, score + bound
                count += 1
                if score - bound > best_scores_heap[0]:
                    _replace_heap_minimum(best_scores_heap, score - bound)
                    floor = max(lowest, best_scores_heap[0])
        begin = upto
        block += 1
    return count


@numba_jit(REORDERED_FASTMATH)
def _replace_heap_minimum(heap: NDArray[np.float64], value: float) -> None:
    place, end = 0, heap.shape[0]
    while True:
        child = 2 * place + 1
        if child + 1 < end and heap[child + 1] < heap[child]:
            child += 1
        if child >= end or heap[child] >= value:
            break
        heap[place] = heap[child]
        place = child
    heap[place] = value


@numba_jit(REORDERED_FASTMATH)
def add_hamming_distances(
    begins: Addresses,
    first: NDArray[np.int64],
    rows: NDArray[np.int64],
    query: Words,
    out: NDArray[np.int64],
) -> None:
    """Add to `out` how many bits of the query differ from the code of each of these rows; blocks
    begin at `begins` (c,), with the rows from `first` (c + 1,) on."""
    words = query.shape[0]
    for number in range(rows.shape[0]):
        at = _address(begins, first, rows[number], 8 * words)
        code = nb.carray(_words_at(at), (words,))
        differ = np.uint64(0)
        for i in range(words):
            differ += _popcount(code[i] ^ query[i])
        out[number] += np.int64(differ)


@numba_jit(REORDERED_FASTMATH)
def weighted_bit_sums(
    begins: Addresses,
    first: NDArray[np.int64],
    rows: NDArray[np.int64],
    ends: NDArray[np.int64],
    planes: Words,
    out: NDArray[np.int64],
) -> None:
    """Of the whole code of each of these rows, to out (n, 2): its ones, and the sum over its ones
    of the whole numbers of which planes (PLANES, words) hold the bits. Level l of the codes ends
    at word ends[l]; its blocks begin at begins[l] (c,), with the rows from `first` (c + 1,) on."""
    for number in range(rows.shape[0]):
        ones = units = twos = fours = eights = np.uint64(0)
        begin = np.int64(0)
        for level in range(ends.shape[0]):
            words = ends[level] - begin
            at = _address(begins[level], first, rows[number], 8 * words)
            code = nb.carray(_words_at(at), (words,))
            weights = planes[:, begin : ends[level]]
            one, two, four, eight = weights[0], weights[1], weights[2], weights[3]
            for i in range(words):
                word = code[i]
                ones += _popcount(word)
                units += _popcount(word & one[i])
                twos += _popcount(word & two[i])
                fours += _popcount(word & four[i])
                eights += _popcount(word & eight[i])
            begin = ends[level]
        out[number, 0] = np.int64(ones)
        out[number, 1] = np.int64(units + 2 * twos + 4 * fours + 8 * eights)


@numba_jit(REORDERED_FASTMATH)
def exact_products(
    begins: Addresses,
    first: NDArray[np.int64],
    rows: NDArray[np.int64],
    query: NDArray[np.float32],
    out: NDArray[np.float64],
) -> None:
    """The products of these float32 rows with the query, in float64: each term is exact, and the
    sums of equal rows are equal. Blocks begin at `begins`, with the rows from `first` on."""
    for number in range(rows.shape[0]):
        at = _address(begins, first, rows[number], 4 * query.shape[0])
        row = nb.carray(_floats_at(at), query.shape)
        total = 0.0
        for i in range(query.shape[0]):
            total += np.float64(row[i]) * np.float64(query[i])
        out[number] = total


@numba_jit(REORDERED_FASTMATH)
def squared_norm(row: NDArray[np.float32]) -> float:
    """The sum of a row's squares, in float64."""
    total = 0.0
    for i in range(row.shape[0]):
        total += np.float64(row[i]) * np.float64(row[i])
    return total


@numba_jit(REORDERED_FASTMATH)
def quantize_to_bit_planes(
    numbers: NDArray[np.float32], signs: Words, planes: Words
) -> tuple[float, float, float, float, float]:
    """The signs of (64 n,) float32 numbers, and the numbers rounded to 2^PLANES steps.

    signs (n,): bit j of word i is 1 where number 64 i + j is not negative. planes (PLANES, n): the
    same bits of a whole number w, 0 to 2^PLANES - 1, for which low + step w is nearest.
    Returns low, step, and of these rounded numbers: the sum, the product with the numbers, the sum
    of squares.
    """
    low, high = numbers[0], numbers[0]
    for i in range(numbers.shape[0]):
        low, high = min(low, numbers[i]), max(high, numbers[i])
    step = (high - low) / np.float32(2**PLANES - 1)
    inverse = np.float32(1.0) / step
    total = int8_product = square = 0.0
    whole = np.empty(64, np.uint8)
    eights = whole.view(np.uint64)
    for i in range(planes.shape[1]):
        part = numbers[64 * i : 64 * i + 64]
        sums = sums_of_products = sums_of_squares = np.float32(0.0)
        for j in range(64):
            nearest = np.int32((part[j] - low) * inverse + np.float32(0.5))
            rounded = np.float32(nearest) * step + low
            whole[j] = np.uint8(nearest) | (np.uint8(part[j] >= 0) << np.uint8(PLANES))
            sums += rounded
            sums_of_products += rounded * part[j]
            sums_of_squares += rounded * rounded
        total += sums
        int8_product += sums_of_products
        square += sums_of_squares
        for plane in range(PLANES + 1):
            word = np.uint64(0)
            for j in range(8):  # the product gathers one bit of each byte in the highest byte
                ones = (eights[j] >> np.uint64(plane)) & LOW_BIT_OF_EACH_BYTE
                word |= ((ones * BIT_GATHER_FACTOR) >> np.uint64(56)) << np.uint64(8 * j)
            if plane < PLANES:
                planes[plane, i] = word
            else:
                signs[i] = word
    return low, step, total, int8_product, square
