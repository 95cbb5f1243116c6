"""`placewise datasets check` and `ground-truth` as people and programs call them."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from lab.datasets.open_dataset import open_evaluation_set
from tests.lab.unit.data_sets import save_lists, save_names, utm_name, write_csv, write_photos
from tests.support.commands import run, run_json

run_datasets = partial(run_json, "datasets")


def street(base: Path, folder: str, metres: list[float]) -> list[str]:
    names = [utm_name(480_000 + east, 4_880_000, note="1_osl") for east in metres]
    write_photos(base / folder, names)
    return [f"{folder}/{name}" for name in names]


def whole_set(base: Path) -> None:
    street(base, "database", [0, 20, 100])
    street(base, "queries", [10, 500])
    street(base, "gsv_xs/train/osl", [0, 1, 2])
    street(base, "gsv_xs/train/trt", [0, 1])


def test_check_lists_what_the_folder_contains(tmp_path: Path) -> None:
    whole_set(tmp_path)
    reported = run_datasets("check", tmp_path, "--decode")
    assert reported["layouts"] == ["gsv_xs", "database and queries folders"]
    assert reported["training"]["cities"] == {
        "osl": {"places": 1, "photos": 3},
        "trt": {"places": 1, "photos": 2},
    }
    assert reported["training"]["photos_per_place"] == {"least": 2, "median": 2.5, "most": 3}
    (one,) = reported["evaluation"]
    assert (one["database"], one["queries"], one["queries_without_positives"]) == (3, 2, 1)
    assert one["fingerprint"] == open_evaluation_set(tmp_path).fingerprint
    assert (reported["decoded"], reported["problems"]) == (True, [])
    printed = run("datasets", "check", tmp_path).output
    for part in ("5 photos of 2 places in 2 cities", "osl", one["fingerprint"][:12], "25 m"):
        assert part in printed


def test_check_names_photos_that_do_not_decode_with_their_count(tmp_path: Path) -> None:
    whole_set(tmp_path)
    broken = sorted((tmp_path / "database").iterdir())[:2]
    broken[0].write_bytes(broken[0].read_bytes()[:-40])
    broken[1].write_bytes(b"no photo")
    assert run_datasets("check", tmp_path)["problems"] == []
    (problem,) = run_datasets("check", tmp_path, "--decode", code=1)["problems"]
    assert (problem["code"], problem["count"]) == ("undecodable_photo", 2)
    assert all(
        str(path) in reported for path, reported in zip(broken, problem["examples"], strict=True)
    )


def test_check_names_photos_that_are_listed_and_not_there(tmp_path: Path) -> None:
    rows = [(f"{number}.jpg", "hall") for number in range(7)]
    write_csv(tmp_path / "train.csv", ("path", "place"), rows)
    (problem,) = run_datasets("check", tmp_path, code=1)["problems"]
    assert (problem["code"], problem["count"]) == ("missing_photo", 7)
    assert problem["examples"] == [str(tmp_path / f"{number}.jpg") for number in range(5)]
    assert "and 2 more" in run("datasets", "check", tmp_path, code=1).output


def test_check_names_a_ground_truth_that_differs_from_the_positions(tmp_path: Path) -> None:
    save_names(tmp_path / "my_dbImages.npy", street(tmp_path, "db", [0, 100]))
    save_names(tmp_path / "my_qImages.npy", street(tmp_path, "q", [0, 100]))
    save_lists(tmp_path / "my_gt.npy", [[0], [0]])
    (problem,) = run_datasets("check", tmp_path, code=1)["problems"]
    assert (problem["code"], problem["count"]) == ("ground_truth_differs", 1)


def test_check_names_duplicates(tmp_path: Path) -> None:
    photos = street(tmp_path, "db", [0, 100])
    save_names(tmp_path / "my_dbImages.npy", [*photos, photos[0]])
    save_names(tmp_path / "my_qImages.npy", photos[:1])
    codes = [problem["code"] for problem in run_datasets("check", tmp_path, code=1)["problems"]]
    assert codes == ["listed_twice", "query_in_database"]


def test_check_goes_on_where_one_set_can_not_be_opened(tmp_path: Path) -> None:
    whole_set(tmp_path)
    save_names(tmp_path / "lost_dbImages.npy", ["a.jpg"])
    reported = run_datasets("check", tmp_path, code=1)
    assert [one["name"] for one in reported["evaluation"]] == [tmp_path.name.replace("_", "")]
    assert [problem["code"] for problem in reported["problems"]] == ["bad_list"]


def test_check_of_a_folder_of_nothing_says_so(tmp_path: Path) -> None:
    assert run_datasets("check", tmp_path, code=1)["code"] == "no_data_set"


@pytest.mark.parametrize("kind", ["npy", "txt", "csv"])
def test_ground_truth_is_written_for_lists_of_every_kind(tmp_path: Path, kind: str) -> None:
    database = [utm_name(480_000 + m, 4_880_000) for m in (100, 25, 0, 25.01)]
    queries = [utm_name(480_000 + m, 4_880_000) for m in (0, 900)]
    lists = {}
    for role, names in (("database", database), ("queries", queries)):
        lists[role] = tmp_path / f"{role}.{kind}"
        match kind:
            case "npy":
                save_names(lists[role], names)
            case "txt":
                lists[role].write_text("\n".join(names) + "\n\n")
            case _:
                write_csv(lists[role], ("path",), [(name,) for name in names])
    out = tmp_path / "gt.npy"
    reported = run_datasets(
        "ground-truth", "--database", lists["database"], "--queries", lists["queries"],
        "--radius", 25, "--out", out,
    )  # fmt: skip
    assert (reported["positives"], reported["queries_without_positives"]) == (2, 1)
    assert np.load(out, allow_pickle=True).tolist() == [[1, 2], []]
    assert json.loads((tmp_path / "gt.json").read_text())["rule"] == "radius 25 m"


def test_ground_truth_by_another_rule_and_what_it_refuses(tmp_path: Path) -> None:
    table = write_csv(tmp_path / "l.csv", ("path", "frame"), [("a", 1), ("b", 3), ("c", 9)])
    lists = ("ground-truth", "--database", table, "--queries", table, "--out")
    out = tmp_path / "gt.npy"
    run_datasets(*lists, out, "--rule", "frames 2")
    assert np.load(out, allow_pickle=True).tolist() == [[0, 1], [0, 1], [2]]
    assert run_datasets(*lists, out, code=1)["code"] == "no_positions"
    assert (
        run_datasets(*lists, out, "--rule", "frames 2", "--radius", 3, code=1)["code"]
        == "which_rule"
    )
    assert run_datasets(*lists, tmp_path / "gt.txt", code=1)["code"] == "bad_out"
    assert run_datasets(*lists, out, "--radius", "inf", code=1)["code"] == "unknown_rule"
    missing = tmp_path / "nowhere" / "gt.npy"
    assert run_datasets(*lists, missing, "--rule", "frames 2", code=1)["code"] == "out_unwritable"
