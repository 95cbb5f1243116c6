"""Ground truths in `.npy`: what is written, what is read, and what is refused unread."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.datasets.ground_truth_files import (
    read_ground_truth,
    read_integer_lists,
    read_names,
    write_ground_truth,
    write_integer_lists,
)
from shared.errors import InvalidRequest
from tests.lab.unit.data_sets import refused


def objects(rows: list[Any]) -> np.ndarray[Any, Any]:
    array = np.empty(len(rows), object)
    for number, row in enumerate(rows):
        array[number] = row
    return array


def write_pickle(path: Path, value: object, protocol: int, rows: int) -> None:
    """A `.npy` that promises so many objects, and holds this pickle."""
    np.save(path, objects([[]] * rows), allow_pickle=True)
    header = path.read_bytes()[:128]
    path.write_bytes(header + pickle.dumps(value, protocol=protocol))


def rows_of(path: Path) -> list[list[int]]:
    return [row.tolist() for row in read_integer_lists(path)]


@given(st.lists(st.lists(st.integers(0, 2**40), unique=True)))
def test_written_files_are_read_by_numpy_and_by_the_reader(
    tmp_path_factory: pytest.TempPathFactory, rows: list[list[int]]
) -> None:
    path = tmp_path_factory.mktemp("gt") / "gt.npy"
    rows = [sorted(row) for row in rows]
    write_integer_lists(path, [np.array(row, np.int64) for row in rows])
    assert rows_of(path) == rows
    loaded = np.load(path, allow_pickle=True)
    assert loaded.dtype == object
    assert loaded.shape == (len(rows),)
    assert all(type(row) is list for row in loaded)
    assert loaded.tolist() == rows


@pytest.mark.parametrize("protocol", range(5))
@pytest.mark.parametrize(
    "make",
    [
        lambda: [[4, 2], [], [300_000]],
        lambda: [np.array([2, 4]), np.array([], np.int64), np.array([300_000], np.int32)],
        lambda: [[np.int64(2), np.int64(4)], [], (300_000,)],
        lambda: [np.array([2, 4], ">i8"), np.array([], np.uint8), 300_000],
    ],
)
def test_lists_arrays_and_numbers_of_every_age_are_read(
    tmp_path: Path, make: Callable[[], list[Any]], protocol: int
) -> None:
    write_pickle(tmp_path / "gt.npy", objects(make()), protocol, 3)
    assert rows_of(tmp_path / "gt.npy") == [[2, 4], [], [300_000]]


def test_tables_of_integers_are_read_without_their_padding(tmp_path: Path) -> None:
    path = tmp_path / "gt.npy"
    np.save(path, np.array([[3, 1, -1], [5, 5, 2]], np.int32))
    assert rows_of(path) == [[1, 3], [2, 5]]
    np.save(path, np.array([7, 8]))
    assert rows_of(path) == [[7], [8]]
    np.save(path, np.array([[3, 1], [5, 2]], dtype=object), allow_pickle=True)
    assert rows_of(path) == [[1, 3], [2, 5]]


class Harm:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (os.environ["PLACEWISE_TEST_HARM"],)


def test_pickles_of_other_classes_are_refused_and_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    harm = tmp_path / "harm"
    monkeypatch.setenv("PLACEWISE_TEST_HARM", str(harm))
    for value in (Harm(), objects([[Harm()]]), objects([[np.str_("a")]])):
        write_pickle(tmp_path / "gt.npy", value, 4, 1)
        with refused("bad_ground_truth"):
            read_integer_lists(tmp_path / "gt.npy")
    assert not harm.exists()


@pytest.mark.parametrize(
    "value",
    [
        objects([["a"]]),
        objects([[1.5]]),
        objects([[-1]]),
        objects([None]),
        objects([{1: 2}]),
        objects([np.array([1.5])]),
        objects([[1], [2]]),  # two rows, and the file promises one
        [1, 2],
    ],
)
def test_other_things_than_lists_of_indices_are_refused(tmp_path: Path, value: object) -> None:
    write_pickle(tmp_path / "gt.npy", value, 4, 1)
    with pytest.raises(InvalidRequest, match="ground-truth"):
        read_integer_lists(tmp_path / "gt.npy")


@given(st.binary(max_size=80))
def test_corrupt_files_are_an_explained_error(
    tmp_path_factory: pytest.TempPathFactory, end: bytes
) -> None:
    path = tmp_path_factory.mktemp("gt") / "gt.npy"
    write_integer_lists(path, [np.array([1, 2])])
    for begin in (path.read_bytes()[:128], path.read_bytes()[:-12], b""):
        path.write_bytes(begin + end)
        with contextlib.suppress(InvalidRequest):  # any other error fails
            assert all(row.dtype == np.int64 for row in read_integer_lists(path))


def test_names_are_texts_in_one_dimension(tmp_path: Path) -> None:
    path = tmp_path / "names.npy"
    np.save(path, np.array(["b/ü.jpg", "a.jpg"]))
    assert read_names(path) == ["b/ü.jpg", "a.jpg"]
    for wrong in (np.array([1]), np.array([["a"]]), objects(["a"])):
        np.save(path, wrong, allow_pickle=True)
        with refused("bad_list"):
            read_names(path)


def written(tmp_path: Path) -> Path:
    path = tmp_path / "gt.npy"
    rows = [np.array([0, 2]), np.array([], np.int64)]
    write_ground_truth(path, rows, database=["a", "b", "c"], queries=["x", "y"], rule="radius 25 m")
    return path


def test_ground_truth_belongs_to_its_own_lists(tmp_path: Path) -> None:
    path = written(tmp_path)
    rows, rule = read_ground_truth(path, database=["a", "b", "c"], queries=["x", "y"])
    assert ([row.tolist() for row in rows], rule) == ([[0, 2], []], "radius 25 m")
    for database, queries in (("acb", "xy"), ("abc", "yx"), ("abcd", "xy"), ("abc", "x")):
        with refused("ground_truth_of_other_lists"):
            read_ground_truth(path, database=[*database], queries=[*queries])


def test_published_ground_truth_is_checked_by_its_rows_and_indices(tmp_path: Path) -> None:
    path = written(tmp_path)
    path.with_suffix(".json").unlink()
    _, rule = read_ground_truth(path, database=["b", "a", "c"], queries=["y", "x"])
    assert rule == "given by gt.npy"
    for database, queries in (("ab", "xy"), ("abc", "xyz")):
        with refused("ground_truth_of_other_lists"):
            read_ground_truth(path, database=[*database], queries=[*queries])


@pytest.mark.parametrize("message", ["", "[]", "{}", json.dumps({"database": 3, "rule": "x"})])
def test_a_corrupt_fingerprint_of_the_lists_is_refused(tmp_path: Path, message: str) -> None:
    path = written(tmp_path)
    path.with_suffix(".json").write_text(message)
    with refused("bad_ground_truth"):
        read_ground_truth(path, database=["a", "b", "c"], queries=["x", "y"])
