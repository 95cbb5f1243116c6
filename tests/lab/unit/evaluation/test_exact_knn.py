"""Exact search in blocks: the full product's ranking, whatever the blocks, ties by index."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lab.evaluation.exact_knn import exact_knn, has_faiss_gpu
from tests.lab.unit.data_sets import refused

pytestmark = pytest.mark.numerics

Rows = np.ndarray[Any, np.dtype[np.float32]]


def unit_rows(count: int, dimension: int, seed: int) -> Rows:
    rows = np.random.default_rng(seed).standard_normal((count, dimension)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return rows


def full_product(queries: Rows, database: Rows, k: int) -> Any:
    scores = (queries.astype(np.float64) @ database.astype(np.float64).T).astype(np.float32)
    return np.argsort(-scores, axis=1, kind="stable")[:, :k]


def test_hundred_thousand_rows_in_blocks_rank_as_in_the_full_product() -> None:
    database, queries = unit_rows(100_000, 64, 0), unit_rows(40, 64, 1)
    # 4,000 rows a block, and less than half of the queries at once
    found = exact_knn(queries, database, 20, block_bytes=4_000 * 64 * 4)
    assert found.indices.tolist() == full_product(queries, database, 20).tolist()
    gathered = np.einsum("qd,qkd->qk", queries, database[found.indices])
    np.testing.assert_allclose(found.scores, gathered, atol=1e-6)


@pytest.mark.parametrize("rows_a_block", [3, 7, 50, 1000])
def test_copies_are_ranked_by_index_in_blocks_of_any_size(rows_a_block: int) -> None:
    """Each row lies there 40 times, more often than there are candidates."""
    originals = unit_rows(5, 33, 2)
    database = np.tile(originals, (40, 1))
    found = exact_knn(originals, database, 8, block_bytes=rows_a_block * 33 * 4)
    for place, row in enumerate(found.indices):
        assert row.tolist() == [place + 5 * copy for copy in range(8)]


def test_rows_without_length_are_ranked_by_index() -> None:
    """A photo of one colour may have no features: its row is 0 and nothing is nearer than else."""
    found = exact_knn(np.zeros((1, 4), np.float32), unit_rows(60, 4, 3), 5, block_bytes=160)
    assert found.indices.tolist() == [[0, 1, 2, 3, 4]]
    assert found.scores.tolist() == [[0, 0, 0, 0, 0]]


def test_ranking_is_no_longer_than_the_database_and_is_there_for_no_query() -> None:
    database = unit_rows(3, 8, 4)
    assert exact_knn(database, database, 10).indices.shape == (3, 3)
    assert exact_knn(database[:0], database, 2).indices.shape == (0, 2)


def test_rows_are_read_from_a_mapped_file(tmp_path: Any) -> None:
    database, queries = unit_rows(500, 16, 5), unit_rows(9, 16, 6)
    np.save(tmp_path / "rows.npy", database)
    mapped = np.load(tmp_path / "rows.npy", mmap_mode="r")
    found = exact_knn(queries, mapped, 5, block_bytes=64 * 16 * 4)
    assert found.indices.tolist() == full_product(queries, database, 5).tolist()


@pytest.mark.skipif(has_faiss_gpu(), reason="faiss has a GPU here")
def test_gpu_that_faiss_does_not_have_is_a_named_error() -> None:
    with refused("faiss_gpu_missing", "Omit --faiss-gpu"):
        exact_knn(unit_rows(2, 4, 8), unit_rows(2, 4, 9), 1, faiss_gpu=True)
