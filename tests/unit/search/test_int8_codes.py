"""Int8 codes: no score further off than its bound, on rows that are made to break it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.search.kernels import INT32_SAFE_TERMS, int8_product
from shared.codes.int8_codes import INT8_MAX, QUERY_MAX, Int8Codes, Int8Query, int8_codes
from shared.codes.rotation import get_rotation
from shared.codes.serialization import (
    decode_int8_codes,
    decode_sign_codes,
    encode_int8_codes,
    encode_sign_codes,
)

pytestmark = pytest.mark.numerics

ANYLOC = 98_304

Rows = NDArray[np.float32]


def adversarial(dimension: int) -> Rows:
    """Noise, single numbers, equal numbers, two sizes far apart, heavy tails, tiny and zero."""
    rng = np.random.default_rng(dimension)
    rows = rng.standard_normal((12, dimension))
    rows[1] = np.eye(1, dimension, dimension // 3)
    rows[2] = 1.0
    rows[3] = np.where(rng.random(dimension) < 0.5, 1e-6, 1.0)
    rows[4] = rng.standard_cauchy(dimension)
    rows[5, -(-dimension // 8) :] = 0
    turn = get_rotation(dimension)
    if dimension == turn.padded <= 512:  # a row that the rotation turns into one strong number
        rows[6] = turn.rotate(np.eye(dimension, dtype=np.float32))[:, 5]
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    rows[7] = 0
    rows[8] = rows[0]
    found: Rows = rows.astype(np.float32)
    found[9] *= np.float32(1.0009)  # as far from length 1 as a row may be
    found[10] = 0
    found[10, 0] = 1e-35
    return found


@pytest.mark.parametrize("dimension", [1, 64, 100, 512, 7168, ANYLOC])
def test_no_score_is_further_off_than_its_bound(dimension: int) -> None:
    rows = adversarial(dimension)
    codes = int8_codes(rows)
    for row in (*rows[[0, 1, 2, 4, 6]], -rows[3], rows[5] * np.float32(1e-20)):
        if not row.any():
            continue
        query = Int8Query.from_row(row)
        whole = codes.numbers.astype(np.int64) @ query.numbers.astype(np.int64)
        scores = codes.scales.astype(np.float64) * query.scale * whole
        bounds = codes.errors + codes.lengths.astype(np.float64) * query.error
        unit = row.astype(np.float64) / np.linalg.norm(row.astype(np.float64))
        errors = np.abs(rows.astype(np.float64) @ unit - scores)
        assert np.all(errors <= bounds + 1e-12)
        assert bounds.max() < 0.04 + (dimension == 1)
    assert (bounds[7], codes.scales[7]) == (0.0, 0.0)


def test_bound_is_as_tight_as_a_byte_for_a_number_allows() -> None:
    """Of noise the largest of m numbers decides about the step: 0.0103 at 98,304."""
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((8, ANYLOC)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    codes = int8_codes(rows)
    assert 0.008 < codes.errors.min() <= codes.errors.max() < 0.0125
    assert Int8Query.from_row(rows[0]).error < 2e-4


@pytest.mark.parametrize("dimension", [64, 448, 7168])
def test_computed_rotation_is_as_near_to_the_exact_one_as_is_claimed(dimension: int) -> None:
    """The exact one: the same steps on whole numbers of float64, which errs 10^-9 as much."""
    turn = get_rotation(dimension)
    rows = adversarial(dimension)[:10]
    exact = np.zeros((len(rows), turn.padded))
    exact[:, :dimension] = rows
    for number in range(2):
        if number:
            exact = exact.reshape(len(rows), -1, 16)[:, turn.runs].reshape(len(rows), -1)
        exact = exact * np.sign(turn.signs[number].astype(np.float64))
        parts = exact.reshape(len(rows), turn.blocks, turn.block)
        step = 1
        while step < turn.block:
            pairs = parts.reshape(len(rows), turn.blocks, -1, 2, step)
            parts = np.stack(
                [pairs[:, :, :, 0] + pairs[:, :, :, 1], pairs[:, :, :, 0] - pairs[:, :, :, 1]], 3
            ).reshape(parts.shape)
            step *= 2
        parts = parts / math.sqrt(turn.block)
        if turn.blocks > 1:
            parts = parts - 2 / turn.blocks * parts.sum(axis=1, keepdims=True)
        exact = parts.reshape(len(rows), -1)
    off = np.linalg.norm(turn.rotate(rows) - exact, axis=1)
    assert np.all(off <= turn.error * np.linalg.norm(rows.astype(np.float64), axis=1))
    assert turn.error < 1e-5


def test_products_of_the_largest_numbers_are_exact() -> None:
    """Where 32 bits would not hold their sum."""
    length = 3 * INT32_SAFE_TERMS + 64
    row = np.full(length, -INT8_MAX, np.int8)
    query = np.full(length, QUERY_MAX, np.int16)
    assert int8_product(row, query) == -INT8_MAX * QUERY_MAX * length
    assert INT8_MAX * QUERY_MAX * INT32_SAFE_TERMS < 2**31


def same(a: Int8Codes, b: Int8Codes) -> bool:
    pairs = ((a.numbers, b.numbers), (a.scales, b.scales), (a.errors, b.errors))
    return all(map(np.array_equal, *zip(*pairs, strict=True))) and np.array_equal(
        a.lengths, b.lengths
    )


def test_stored_codes_are_those_that_were_made_and_nothing_else_is_taken_for_them() -> None:
    rows = adversarial(512)
    data = encode_int8_codes(rows, "ab" * 32)
    expected = {"rows": len(rows), "dimension": 512, "chunk_sha256": "ab" * 32}
    assert same(decode_int8_codes(data, **expected), int8_codes(rows))  # type: ignore[arg-type]
    for change in ({"rows": 8}, {"dimension": 513}, {"chunk_sha256": "cd" * 32}):
        with pytest.raises(ValueError, match="other rows"):
            decode_int8_codes(data, **(expected | change))  # type: ignore[arg-type]
    damaged = bytearray(data)
    damaged[-70] ^= 1
    for wrong in (bytes(damaged), data[:-9], b"", encode_sign_codes(rows, "ab" * 32)):
        with pytest.raises(ValueError):
            decode_int8_codes(wrong, **expected)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="levels"):
        decode_sign_codes(data, **expected)  # type: ignore[arg-type]
