"""Codes: a rotation that keeps cosines, estimates that err as the theory says, files that are
those of their rows or refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from services.search.sign_code_search import hamming_deviation
from shared.codes.rotation import get_rotation
from shared.codes.serialization import decode_sign_codes, encode_sign_codes
from shared.codes.sign_codes import WORD_BITS, SignCodes, encode_signs, level_words, pack_signs

pytestmark = pytest.mark.numerics

ANYLOC = 98_304

Rows = NDArray[np.float32]


def normalised(rows: NDArray[np.float64]) -> Rows:
    found: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return found


def adversarial(kind: str, count: int, rng: np.random.Generator) -> Rows:
    """Rows that a bad rotation would leave uneven."""
    rows = np.zeros((count, ANYLOC))
    if kind == "noise":
        rows[:] = rng.standard_normal(rows.shape)
    elif kind == "one cluster":
        for row in rows:
            begin = 1536 * rng.integers(64)
            row[begin : begin + 1536] = rng.standard_normal(1536)
    else:
        strong = int(kind.removesuffix(" strong numbers"))
        for row in rows:
            row[rng.choice(ANYLOC, strong, replace=False)] = rng.standard_normal(strong)
    return normalised(rows)


@pytest.mark.parametrize(
    ("dimension", "padded"),
    [(1, 64), (64, 64), (65, 128), (192, 192), (320, 320), (7168, 7168), (10_000, 10_240)],
)
def test_rotation_preserves_inner_products(dimension: int, padded: int) -> None:
    rows = np.random.default_rng(dimension).standard_normal((5, dimension)).astype(np.float32)
    turn = get_rotation(dimension)
    assert turn.padded == padded
    rotated = turn.rotate(rows)
    assert rotated.shape == (5, padded)
    np.testing.assert_allclose(rotated @ rotated.T, rows @ rows.T, atol=2e-6 * dimension, rtol=2e-6)


def test_rotation_is_orthonormal() -> None:
    turn = get_rotation(448)
    matrix = turn.rotate(np.eye(448, dtype=np.float32)).astype(np.float64)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(448), atol=1e-6)
    assert np.abs(matrix).max() < 6 / math.sqrt(448), "a number stays stronger than the others"


def test_rotation_is_the_same_everywhere_and_always() -> None:
    """Codes lie beside chunks for years: another rotation would make them meaningless."""
    rotated = get_rotation(192).rotate(np.ones((1, 192), np.float32))[0]
    expected = [-11 / 72, -57 / 72, 6 / 72, 8 / 72]
    assert rotated[:4].tolist() == pytest.approx(expected, abs=1e-6)


def test_rows_of_another_length_or_type_are_no_rows_of_the_rotation() -> None:
    strange: list[Any] = [
        np.zeros((2, 63), np.float32),
        np.zeros((2, 64)),
        np.zeros(64, np.float32),
    ]
    for rows in strange:
        with pytest.raises(ValueError, match=r"\(n, 64\) float32"):
            get_rotation(64).rotate(rows)


@pytest.mark.parametrize(
    "kind",
    [
        "noise",
        "one cluster",
        "1 strong numbers",
        "4 strong numbers",
    ],
)
def test_estimates_err_as_the_theory_says_whatever_the_rows(kind: str) -> None:
    rng = np.random.default_rng(7)
    rows, queries = adversarial(kind, 160, rng), adversarial(kind, 120, rng)
    turn = get_rotation(ANYLOC)
    cosines = queries.astype(np.float64) @ rows.T.astype(np.float64)
    apart = np.abs(cosines) < 0.9
    turned, searched = turn.rotate(rows), turn.rotate(queries)
    signs, query_signs = np.sign(turned), np.sign(searched)
    for bits in (4096, 16_384, ANYLOC):
        same = (query_signs[:, :bits] @ signs[:, :bits].T) / bits  # 1 - 2 h / m
        errors = (np.cos(math.pi * (1 - same) / 2) - cosines)[apart]
        deviation = hamming_deviation(bits, ANYLOC)
        assert 0.95 < errors.std() / deviation < 1.05, bits
        assert np.abs(errors).max() / deviation < 5.5, bits
    norms = np.abs(turned).sum(axis=1, dtype=np.float64)
    errors = (searched @ signs.T / norms - cosines)[apart]
    flat = norms**2 / ANYLOC
    deviations = np.broadcast_to(np.sqrt((1 / flat - 1) / (ANYLOC - 1)), cosines.shape)[apart]
    assert 0.95 < (errors / deviations).std() < 1.05
    assert np.abs(errors / deviations).max() < 5.5


def test_estimates_of_duplicate_rows_have_the_stated_error() -> None:
    rng = np.random.default_rng(3)
    place = rng.standard_normal(ANYLOC)
    rows = normalised(place + 0.05 * rng.standard_normal((60, ANYLOC)))
    turned = get_rotation(ANYLOC).rotate(rows)
    signs = np.sign(turned)
    cosines = rows.astype(np.float64) @ rows.T.astype(np.float64)
    same = signs @ signs.T / ANYLOC
    errors = np.cos(math.pi * (1 - same) / 2) - cosines
    assert np.abs(errors).max() < 5.5 * hamming_deviation(ANYLOC, ANYLOC)


def test_bits_are_the_signs_of_the_rotated_row_level_by_level() -> None:
    rows = normalised(np.random.default_rng(5).standard_normal((70, 8192)))
    rows[3] = 0
    codes = encode_signs(rows)
    turned = get_rotation(8192).rotate(rows)
    words = np.concatenate(codes.levels, axis=1)
    for row, bit in ((0, 0), (0, 63), (1, 64), (69, 8191), (5, 4096)):
        word, place = divmod(bit, WORD_BITS)
        assert (int(words[row, word]) >> place) & 1 == (turned[row, bit] >= 0)
    np.testing.assert_array_equal(words, pack_signs(turned))
    assert codes.norms[3] == 0
    assert codes.norms[0] == pytest.approx(np.abs(turned[0]).sum(), rel=1e-5)


@pytest.mark.parametrize(
    ("padded", "words"),
    [(64, (1,)), (7168, (112,)), (8192, (64, 64)), (ANYLOC, (64, 192, 1280))],
)
def test_levels_add_up_to_the_whole_code(padded: int, words: tuple[int, ...]) -> None:
    assert level_words(padded) == words
    assert WORD_BITS * sum(words) == padded


@pytest.fixture(scope="module")
def rows() -> Rows:
    return normalised(np.random.default_rng(1).standard_normal((9, 8192)))


def same(a: SignCodes, b: SignCodes) -> bool:
    return np.array_equal(a.norms, b.norms) and all(
        np.array_equal(one, other) for one, other in zip(a.levels, b.levels, strict=True)
    )


def test_sign_codes_survive_storage(rows: Rows) -> None:
    data = encode_sign_codes(rows, "ab" * 32)
    back = decode_sign_codes(data, rows=9, dimension=8192, chunk_sha256="ab" * 32)
    assert same(back, encode_signs(rows))
    for level in back.levels:
        assert level.ctypes.data % 8 == 0
    empty = encode_sign_codes(rows[:0], "ab" * 32)
    assert len(decode_sign_codes(empty, rows=0, dimension=8192, chunk_sha256="ab" * 32)) == 0


@pytest.mark.parametrize(
    "change", [{"rows": 8}, {"dimension": 8193}, {"chunk_sha256": "cd" * 32}], ids=str
)
def test_codes_of_other_rows_are_refused(rows: Rows, change: dict[str, object]) -> None:
    data = encode_sign_codes(rows, "ab" * 32)
    expected: dict[str, object] = {"rows": 9, "dimension": 8192, "chunk_sha256": "ab" * 32}
    with pytest.raises(ValueError, match="other rows"):
        decode_sign_codes(data, **(expected | change))  # type: ignore[arg-type]


def test_damaged_codes_and_codes_of_another_rotation_are_refused(rows: Rows) -> None:
    whole = encode_sign_codes(rows, "ab" * 32)
    damaged = bytearray(whole)
    damaged[-1] ^= 1
    for data in (bytes(damaged), whole[:-9], whole[:100], b"", b"{}\n", b"[1]\n", b"\x00" * 200):
        with pytest.raises(ValueError):
            decode_sign_codes(data, rows=9, dimension=8192, chunk_sha256="ab" * 32)
    older = whole.replace(b'"seed": 2', b'"seed": 1', 1)
    with pytest.raises(ValueError, match="seed"):
        decode_sign_codes(older, rows=9, dimension=8192, chunk_sha256="ab" * 32)
