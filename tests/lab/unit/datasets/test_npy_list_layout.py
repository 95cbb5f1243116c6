"""Evaluation sets as `.npy` lists: their order, their ground truth, their photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lab.datasets.ground_truth_files import write_ground_truth
from lab.datasets.open_dataset import open_evaluation_set
from shared.errors import InvalidRequest
from tests.lab.unit.data_sets import (
    code_of,
    names,
    pair,
    rows,
    save_lists,
    save_names,
    utm_name,
    write_photos,
)


def npy_set(base: Path, end: str = "_gtImages") -> tuple[list[str], list[str]]:
    """Lists in another order than the names', and a ground truth that is no rule's."""
    pair(base / "val", [0, 100, 200], [0, 100])
    database = [f"val/database/{utm_name(480_000 + m, 4_880_000)}" for m in (200, 0, 100)]
    queries = [f"val/queries/{utm_name(480_000 + m, 4_880_000)}" for m in (100, 0)]
    save_names(base / "sfxs_val_dbImages.npy", database)
    save_names(base / "sfxs_val_qImages.npy", queries)
    save_lists(base / f"sfxs_val{end}.npy", [[2, 0], []])
    return database, queries


@pytest.mark.parametrize("end", ["_gtImages", "_gt", "_gt_25m"])
def test_npy_lists_keep_their_order_and_bring_their_ground_truth(tmp_path: Path, end: str) -> None:
    database, queries = npy_set(tmp_path / "SF_XS", end)
    opened = open_evaluation_set(tmp_path / "SF_XS", "sfxs_val")
    assert names(opened) == (database, queries)
    assert rows(opened) == [[0, 2], []]
    assert opened.rule == f"given by sfxs_val{end}.npy"
    assert all(shot.path.is_file() for shot in (*opened.database, *opened.queries))
    assert rows(open_evaluation_set(tmp_path / "SF_XS", rule="radius")) == [[2], [1]]


def test_npy_lists_without_a_ground_truth_are_measured_by_their_names(tmp_path: Path) -> None:
    npy_set(tmp_path)
    (tmp_path / "sfxs_val_gtImages.npy").unlink()
    opened = open_evaluation_set(tmp_path, "sfxs_val")
    assert (rows(opened), opened.rule) == ([[2], [1]], "radius 25 m")


def test_ground_truth_for_lists_in_another_order_is_refused(tmp_path: Path) -> None:
    database, queries = npy_set(tmp_path)
    truth = tmp_path / "sfxs_val_gtImages.npy"
    positives = [np.array([2]), np.array([1])]
    write_ground_truth(truth, positives, database=database, queries=queries, rule="radius 25 m")
    opened = open_evaluation_set(tmp_path, "sfxs_val")
    assert (rows(opened), opened.rule) == ([[2], [1]], "radius 25 m")
    save_names(tmp_path / "sfxs_val_dbImages.npy", sorted(database))
    with pytest.raises(InvalidRequest) as caught:
        open_evaluation_set(tmp_path, "sfxs_val")
    assert code_of(caught) == "ground_truth_of_other_lists"


def test_lists_may_lie_apart_from_their_photos(tmp_path: Path) -> None:
    database, _ = npy_set(tmp_path / "lists")
    (tmp_path / "lists" / "val").rename(tmp_path / "val")
    opened = open_evaluation_set(tmp_path / "lists")
    assert opened.database[0].path == tmp_path / database[0] == opened.database[0].path.resolve()


def test_sped_has_a_table_of_integers_and_msls_chooses_its_queries(tmp_path: Path) -> None:
    write_photos(tmp_path, ["ref/0.jpg", "ref/1.jpg", "query/0.jpg", "query/1.jpg"])
    for name in ("SPED", "msls_val"):
        save_names(tmp_path / f"{name}_dbImages.npy", ["ref/0.jpg", "ref/1.jpg"])
        save_names(tmp_path / f"{name}_qImages.npy", ["query/0.jpg", "query/1.jpg"])
    np.save(tmp_path / "SPED_gt.npy", np.array([[1, -1], [0, 1]]))
    np.save(tmp_path / "msls_val_qIdx.npy", np.array([1]))
    save_lists(tmp_path / "msls_val_pIdx.npy", [[0]])
    assert rows(open_evaluation_set(tmp_path, "SPED")) == [[1], [0, 1]]
    msls = open_evaluation_set(tmp_path, "msls_val")
    assert (names(msls)[1], rows(msls)) == (["query/1.jpg"], [[0]])


def test_list_of_queries_that_is_missing_is_named(tmp_path: Path) -> None:
    npy_set(tmp_path)
    (tmp_path / "sfxs_val_qImages.npy").unlink()
    with pytest.raises(InvalidRequest, match=r"sfxs_val_qImages\.npy") as caught:
        open_evaluation_set(tmp_path, "sfxs_val")
    assert code_of(caught) == "bad_list"
