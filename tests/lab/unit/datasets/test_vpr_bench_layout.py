"""Evaluation sets of VPR-Bench: numbered photos and their ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab.datasets.check import inspect_dataset
from lab.datasets.open_dataset import evaluation_set_names, open_evaluation_set
from shared.errors import InvalidRequest, NotFound
from tests.lab.unit.data_sets import code_of, names, rows, write_photos


def write_bench(base: Path, truth: list[tuple[Any, Any]]) -> Path:
    """Eleven reference photos and three queries."""
    write_photos(base / "ref", [f"{number}.jpg" for number in range(11)])
    write_photos(base / "query", [f"{number:07d}.jpg" for number in range(3)])
    table = np.empty((len(truth), 2), object)
    for row, (query, positives) in enumerate(truth):
        table[row, 0], table[row, 1] = query, positives
    np.save(base / "ground_truth_new.npy", table, allow_pickle=True)
    return base


def test_photos_are_numbered_in_numeric_order_and_rows_belong_to_their_query(
    tmp_path: Path,
) -> None:
    bench = write_bench(tmp_path / "Corridor", [(2, [10, 9]), (0, np.array([2, 3]))])
    assert evaluation_set_names(tmp_path) == ("corridor",)
    opened = open_evaluation_set(bench)
    assert names(opened)[0] == [f"ref/{number}.jpg" for number in range(11)]
    assert names(opened)[1] == [f"query/{number:07d}.jpg" for number in range(3)]
    assert rows(opened) == [[2, 3], [], [9, 10]]
    assert opened.rule == "given by ground_truth_new.npy"


def test_numbers_of_photos_are_frames_for_a_rule(tmp_path: Path) -> None:
    bench = write_bench(tmp_path, [(0, [0])])
    assert rows(open_evaluation_set(bench, rule="frames 1")) == [[0, 1], [0, 1, 2], [1, 2, 3]]


def test_numbered_frames_in_folders_need_no_table(tmp_path: Path) -> None:
    write_photos(tmp_path / "database", [f"frame_{number:04d}.jpg" for number in (5, 6, 20)])
    write_photos(tmp_path / "queries", ["img-7.jpg"])
    assert rows(open_evaluation_set(tmp_path, rule="frames 2")) == [[0, 1]]


@pytest.mark.parametrize(
    ("truth", "code"),
    [
        ([(3, [0])], "ground_truth_of_other_lists"),
        ([(0, [11])], "ground_truth_of_other_lists"),
        ([(0, [-1])], "bad_ground_truth"),
        ([("first", [1])], "bad_ground_truth"),
        ([([0, 1], [1])], "bad_ground_truth"),
    ],
)
def test_a_ground_truth_of_other_photos_is_refused(
    truth: list[tuple[Any, Any]], code: str, tmp_path: Path
) -> None:
    with pytest.raises(InvalidRequest) as refused:
        open_evaluation_set(write_bench(tmp_path, truth))
    assert code_of(refused) == code


def test_the_check_of_a_folder_names_the_layout(tmp_path: Path) -> None:
    bench = write_bench(tmp_path, [(0, [0])])
    assert inspect_dataset(bench).layouts == ("VPR-Bench",)


def test_a_missing_table_is_described_by_its_header(tmp_path: Path) -> None:
    header = "path,latitude,longitude,heading,place,frame,sequence"
    with pytest.raises(NotFound, match=header):
        open_evaluation_set(tmp_path)
    write_photos(tmp_path / "database", ["a.jpg", "c.jpg"])
    write_photos(tmp_path / "queries", ["b.jpg"])
    for rule in (None, "frames 2", "heading"):
        with pytest.raises(InvalidRequest, match=header):
            open_evaluation_set(tmp_path, rule=rule)
