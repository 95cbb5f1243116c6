"""Predictions files: the predecessor's format, exactly counted, and what is refused."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.commands import run_json

evaluate = partial(run_json, "evaluate")
TRUTH = [[4, 2], [1], [], [3], [0, 5]]
PREDICTED = [[4, 1, 2, 0, 3], [3, 0, 1, 2, 4], [5, 4, 3, 2, 1], [5, 4, 2, 1, 0], [5, 0, 1, 2, 3]]
"""right at rank 1, rank 3, nothing to find, nowhere, rank 1"""


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Predictions, and a ground truth as the field writes it: an object array of lists."""
    np.save(tmp_path / "found.npy", np.array(PREDICTED, np.int64))
    truth = np.empty(len(TRUTH), object)
    truth[:] = TRUTH
    np.save(tmp_path / "gt.npy", truth, allow_pickle=True)
    return tmp_path / "found.npy", tmp_path / "gt.npy"


def test_recall_is_counted_over_all_queries_up_to_the_columns_that_are_there(
    files: tuple[Path, Path],
) -> None:
    answer = evaluate("--predictions", files[0], "--ground-truth", files[1])
    assert answer["recall"] == {"1": 2 / 5, "5": 3 / 5}
    assert answer["recall_findable"] == {"1": 2 / 4, "5": 3 / 4}
    assert answer["recall_curve"] == [0.4, 0.4, 0.6, 0.6, 0.6]
    assert (answer["queries"], answer["without_positive"]) == (5, 1)
    assert answer["precision_recall"] is None, "a predictions file has no scores"


def test_recall_is_reported_at_the_requested_numbers_of_photos(files: tuple[Path, Path]) -> None:
    given = ("--predictions", files[0], "--ground-truth", files[1])
    answer = evaluate(*given, "--recall-at", "3,1,2", "--depth", 5)
    assert answer["recall"] == {"1": 2 / 5, "2": 2 / 5, "3": 3 / 5}
    for bad in ("1,6", "0,1", "1,1", "one", ""):
        problem = evaluate(*given, "--recall-at", bad, "--depth", 5, code=1)
        assert problem["code"] == "bad_recall_at"


@pytest.mark.parametrize(
    ("array", "code", "message"),
    [
        (np.empty((5, 0), np.int64), "predictions_empty", "(5, 0)"),
        (np.zeros((4, 5), np.int64), "predictions_of_other_queries", "4 queries"),
        (np.array([[0], [1], [2], [-1], [3]]), "bad_predictions", "-1 of query 3"),
        (np.zeros((5, 5), np.float32), "bad_predictions", "float32"),
        (np.zeros(5, np.int64), "bad_predictions", "(5,)"),
        (np.array([[1], ["two"]], object), "bad_predictions", "Python objects"),
    ],
)
def test_file_that_is_no_predictions_of_these_queries_is_refused(
    tmp_path: Path, files: tuple[Path, Path], array: Any, code: str, message: str
) -> None:
    np.save(tmp_path / "bad.npy", array, allow_pickle=True)
    problem = evaluate("--predictions", tmp_path / "bad.npy", "--ground-truth", files[1], code=1)
    assert problem["code"] == code
    assert message in problem["detail"]
    (tmp_path / "bad.npy").write_text("4 1 2")
    problem = evaluate("--predictions", tmp_path / "bad.npy", "--ground-truth", files[1], code=1)
    assert problem["code"] == "bad_predictions"


def lists(folder: Path) -> list[object]:
    """Options that name both lists: one as an array, one as a text."""
    there = [f"database/@{500_000 + 10 * n}.00@4000000.00@32@T@.jpg" for n in range(6)]
    requests = [f"queries/@{500_000 + 10 * n}.00@4000003.00@32@T@.jpg" for n in range(5)]
    np.save(folder / "database.npy", np.array(there))
    (folder / "queries.txt").write_text("\n".join(requests) + "\n")
    return ["--database", folder / "database.npy", "--queries", folder / "queries.txt"]


def test_lists_give_names_and_metres_to_a_report(tmp_path: Path, files: tuple[Path, Path]) -> None:
    out = tmp_path / "out"
    answer = evaluate(
        "--predictions", files[0], "--ground-truth", files[1], "--out", out, *lists(tmp_path)
    )
    assert answer["distance_error"]["queries"] == 5
    (table,) = out.glob("predictions_*.csv")
    first = table.read_text().splitlines()[1].split(",")
    assert first[0].startswith("queries/@500000.00")
    assert first[2].startswith("database/@500040.00")
    assert first[4] == "40.11", "metres: 40 to the east and 3 to the south"
    assert first[5] == "true"
    assert "no photo" in (out / "report.html").read_text()


def test_runs_are_compared_query_by_query_where_their_ground_truth_is_the_same(
    tmp_path: Path, files: tuple[Path, Path]
) -> None:
    truth = ["--ground-truth", files[1]]
    evaluate("--predictions", files[0], *truth, "--out", tmp_path / "before")
    better = np.array(PREDICTED)
    better[[1, 3], 0] = [1, 3]  # won
    better[0, 0] = 5  # lost at rank 1
    np.save(tmp_path / "better.npy", better)
    found = evaluate(
        "--predictions", tmp_path / "better.npy", *truth, "--against", tmp_path / "before",
        "--out", tmp_path / "after",
    )["against"]  # fmt: skip
    assert (found["won"], found["lost"]) == ([1, 3], [0])
    assert found["difference"]["1"]["mean"] == pytest.approx(1 / 5)
    assert "Compared with found" in (tmp_path / "after" / "report.html").read_text()

    other = np.empty(len(TRUTH), object)
    other[:] = [[4], [1], [], [3], [0, 5]]
    np.save(tmp_path / "gt.npy", other, allow_pickle=True)
    problem = evaluate("--predictions", files[0], *truth, "--against", tmp_path / "before", code=1)
    assert problem["code"] == "runs_not_comparable"


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--predictions", "{0}"], "no_ground_truth"),
        (["--predictions", "{0}", "--ground-truth", "{1}", "--database", "{0}"], "one_list"),
        (["--predictions", "{0}", "--data", ".", "--database", "{1}"], "options_contradict"),
        (["--predictions", "{0}", "--data", ".", "--extractor", "x"], "options_contradict"),
        (
            ["--predictions", "{0}", "--ground-truth", "{1}", "--rule", "radius"],
            "options_contradict",
        ),
        (["--ground-truth", "{1}"], "options_contradict"),
        (["--out", "results"], "options_contradict"),
        (["--data", "."], "no_model"),
        (["--data", ".", "--extractor", "x", "--image-size", "native"], "options_contradict"),
        (["--data", ".", "--extractor", "x", "--sample", "3"], "options_contradict"),
    ],
)
def test_options_that_do_not_fit_together_are_refused(
    files: tuple[Path, Path], arguments: list[str], code: str
) -> None:
    filled = [argument.format(*files) for argument in arguments]
    assert evaluate(*filled, code=1)["code"] == code
