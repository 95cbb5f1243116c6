"""Evaluation sets in each known layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import utm
from PIL import Image
from scipy.io import savemat

from lab.datasets.ground_truth_files import write_ground_truth
from lab.datasets.open_dataset import evaluation_set_names, open_evaluation_set
from tests.lab.unit.data_sets import (
    msls_city,
    names,
    pair,
    refused,
    rows,
    save_lists,
    save_names,
    utm_name,
    write_csv,
    write_photo,
    write_photos,
)
from tests.support.photos import exif_with_position

HEADER = "path,latitude,longitude,heading,place,frame,sequence"


def test_pair_of_folders_is_a_set_named_after_its_folder_in_the_order_of_names(
    tmp_path: Path,
) -> None:
    base = tmp_path / "My@City-2024@x"
    pair(base, [100, 25, 0], [500, 0, 50])
    opened = open_evaluation_set(base)
    assert (opened.name, opened.rule, opened.protocol) == (
        "mycity2024x", "radius 25 m", "placewise",
    )  # fmt: skip
    assert rows(opened) == [[0, 1], [1], []]
    assert opened.without_positives.tolist() == [2]
    assert names(opened)[0] == [
        f"database/{utm_name(480_000 + m, 4_880_000)}" for m in (0, 25, 100)
    ]
    assert rows(open_evaluation_set(base, rule="radius 100"))[0] == [0, 1, 2]
    with refused("unknown_rule"):
        open_evaluation_set(base, rule="closeness")


def test_splits_and_several_data_sets_have_names_of_their_own(tmp_path: Path) -> None:
    for folder in ("SF_XS/val", "SF_XS/test", "sf-xs/val", "tokyo_xs/images/test"):
        pair(tmp_path / folder, [0], [10])
    assert evaluation_set_names(tmp_path) == (
        "sfxs_test", "sfxs_val", "sfxs_val_2", "tokyoxs_test",
    )  # fmt: skip
    assert evaluation_set_names(tmp_path / "SF_XS") == ("sfxs_test", "sfxs_val")
    assert len(open_evaluation_set(tmp_path, "tokyoxs_test").queries) == 1
    with refused("which_set", "sfxs_test, sfxs_val"):
        open_evaluation_set(tmp_path)
    with refused("set_missing", "Available: sfxs_test, sfxs_val"):
        open_evaluation_set(tmp_path / "SF_XS", "sfxs_tset")


def test_query_sets_of_sf_xl_share_a_database(tmp_path: Path) -> None:
    pair(tmp_path / "SF_XL" / "test", [0, 25], [0])
    (tmp_path / "SF_XL/test/queries").rename(tmp_path / "SF_XL/test/queries_v1")
    second_queries = [utm_name(480_000 + metres, 4_880_000) for metres in (25, 500)]
    write_photos(tmp_path / "SF_XL/test/queries_v2", second_queries)
    assert evaluation_set_names(tmp_path / "SF_XL") == ("sfxl_test_v1", "sfxl_test_v2")
    assert rows(open_evaluation_set(tmp_path / "SF_XL", "sfxl_test_v1")) == [[0, 1]]
    second = open_evaluation_set(tmp_path / "SF_XL", "sfxl_test_v2")
    assert rows(second) == [[0, 1], []]
    assert second.queries[0].name.startswith("test/queries_v2/")


def test_list_beside_a_folder_is_the_set_in_its_order(tmp_path: Path) -> None:
    pair(tmp_path, [0, 100, 200], [200])
    listed = [f"database/{utm_name(480_000 + m, 4_880_000)}" for m in (200, 0)]
    (tmp_path / "database_images_paths.txt").write_text("\n".join(listed) + "\n")
    opened = open_evaluation_set(tmp_path)
    assert names(opened)[0] == listed
    assert rows(opened) == [[0]]
    (tmp_path / "database_images_paths.txt").write_text("elsewhere.jpg\n")
    with refused("bad_list"):
        open_evaluation_set(tmp_path)


def test_vme_compares_metres_of_different_zones(tmp_path: Path) -> None:
    east = utm_name(480_000, 4_880_000).replace("@32@", "@33@")
    write_photos(tmp_path / "database", [east])
    write_photos(tmp_path / "queries", [utm_name(480_000, 4_880_000)])
    assert rows(open_evaluation_set(tmp_path)) == [[]]
    assert rows(open_evaluation_set(tmp_path, protocol="vme")) == [[0]]
    with refused("unknown_protocol", "placewise, vme"):
        open_evaluation_set(tmp_path, protocol="msls-official")


def gps_photo(path: Path, latitude: float, longitude: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 6)).save(path, exif=exif_with_position(latitude, longitude))


def test_photos_of_a_camera_have_the_position_of_their_exif(tmp_path: Path) -> None:
    gps_photo(tmp_path / "database" / "IMG_1.jpg", 44.07, 8.76)
    gps_photo(tmp_path / "database" / "IMG_2.jpg", 44.0702, 8.76)
    gps_photo(tmp_path / "queries" / "IMG_3.jpg", 44.0703, 8.76)
    opened = open_evaluation_set(tmp_path)
    assert rows(opened) == [[1]]
    assert opened.database[0].zone == "32T"


def test_folders_of_places_are_labels_if_no_photo_has_a_position(tmp_path: Path) -> None:
    write_photos(tmp_path / "database", ["hall/1.jpg", "door/2.jpg", "hall/3.jpg"])
    write_photos(tmp_path / "queries", ["hall/9.jpg"])
    opened = open_evaluation_set(tmp_path)
    assert opened.rule == "place-label"
    assert rows(opened) == [[1, 2]]


def test_empty_folders_and_photos_without_positions_are_errors_that_name_a_table(
    tmp_path: Path,
) -> None:
    with refused("no_evaluation_set", HEADER):
        open_evaluation_set(tmp_path)
    for role, stems in (("database", "ac"), ("queries", "b")):
        (tmp_path / role).mkdir()
        if role == "queries":
            with refused("empty_set", "no query"):
                open_evaluation_set(tmp_path)
        write_photos(tmp_path / role, [f"{stem}.jpg" for stem in stems])
    for rule, code in (
        (None, "no_positions"),
        ("frames 2", "no_frames"),
        ("heading", "no_headings"),
    ):
        with refused(code, HEADER):
            open_evaluation_set(tmp_path, rule=rule)


def test_dbstruct_of_matlab_has_names_metres_and_its_radius(tmp_path: Path) -> None:
    def cells(texts: list[str]) -> Any:
        column = np.empty((len(texts), 1), object)
        column[:, 0] = texts
        return column

    write_photos(tmp_path, ["000/a.jpg", "000/b.jpg", "queries_real/000/q.jpg"])
    struct = {
        "whichSet": "test",
        "dbImageFns": cells(["000/a.jpg", "000/b.jpg"]),
        "utmDb": np.array([[580_000.0, 580_030.0], [4_470_000.0, 4_470_000.0]]),
        "qImageFns": cells(["000/q.jpg"]),
        "utmQ": np.array([[580_011.0], [4_470_000.0]]),
        "numImages": 2.0,
        "numQueries": 1.0,
        "posDistThr": 15.0,
        "posDistSqThr": 225.0,
    }
    savemat(tmp_path / "pitts30k_test.mat", {"dbStruct": struct})
    opened = open_evaluation_set(tmp_path, "pitts30k_test")
    assert (rows(opened), opened.rule) == ([[0]], "radius 15 m")
    assert all(photo.path.is_file() for photo in (*opened.database, *opened.queries))
    savemat(tmp_path / "pitts30k_test.mat", {"other": struct})
    with refused("bad_dbstruct", "no dbStruct"):
        open_evaluation_set(tmp_path, "pitts30k_test")


def test_csv_tables_have_positions_in_degrees_or_metres_across_zones(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.jpg")
    header = (*HEADER.split(","), "weather")
    write_csv(
        tmp_path / "database.csv",
        header,
        [("a.jpg", 48, 11.9999, 370, "x", "3.0", "s", "rain"), ("b.jpg", 48, 12.1, *[""] * 5)],
    )
    metres = utm.from_latlon(48, 12.0001)
    write_csv(
        tmp_path / "queries.csv",
        ("filename", "easting", "northing", "zone", "frame"),
        [("c.jpg", metres[0], metres[1], "33U", 5)],
    )
    opened = open_evaluation_set(tmp_path)
    assert rows(opened) == [[0]]
    first = opened.database[0]
    assert (first.heading, first.place, first.frame, first.sequence) == (10, "x", 3, "s")
    assert first.zone == "32U"
    with refused("no_frames", "1 photos have no frame"):
        open_evaluation_set(tmp_path, rule="frames 2")


def test_photos_of_csv_tables_may_be_in_folders_of_the_same_names(tmp_path: Path) -> None:
    for role, name in (("database", "a.jpg"), ("queries", "q.jpg")):
        write_photo(tmp_path / role / name)
        write_csv(tmp_path / f"{role}.csv", ("filename", "place"), [(name, "x")])
    opened = open_evaluation_set(tmp_path)
    assert opened.database[0].path == tmp_path / "database" / "a.jpg"
    assert opened.queries[0].path == tmp_path / "queries" / "q.jpg"


@pytest.mark.parametrize(
    ("header", "row", "code"),
    [
        (("name", "latitude"), ("a.jpg", 1), "missing_column"),
        (("path", "latitude", "longitude"), ("a.jpg", "north", 8), "bad_table"),
        (("path", "latitude", "longitude"), ("a.jpg", "nan", 8), "bad_table"),
        (("path", "latitude", "longitude"), ("a.jpg", 44, ""), "bad_table"),
        (("path", "latitude", "longitude"), ("a.jpg", 86, 8), "bad_coordinates"),
        (("path", "latitude", "longitude"), ("", 44, 8), "bad_table"),
        (("path", "easting", "northing", "zone"), ("a.jpg", 1, 2, "99Q"), "bad_coordinates"),
        (("path", "frame"), ("a.jpg", 1.5), "bad_table"),
    ],
)
def test_invalid_tables_are_refused(
    tmp_path: Path, header: tuple[str, ...], row: tuple[object, ...], code: str
) -> None:
    write_csv(tmp_path / "database.csv", header, [row])
    write_csv(tmp_path / "queries.csv", ("path", "lat", "lon"), [("q.jpg", 44, 8)])
    with refused(code, "line 2" if code == "bad_table" else None):
        open_evaluation_set(tmp_path)


def test_fingerprint_is_of_names_sizes_positives_and_protocol(tmp_path: Path) -> None:
    for folder in ("a", "b", "c", "d"):
        pair(tmp_path / folder, [0, 100], [0])
    Image.new("RGB", (64, 64), (1, 2, 3)).save(next((tmp_path / "b" / "queries").iterdir()))
    next((tmp_path / "c" / "queries").iterdir()).unlink()
    write_photo(tmp_path / "c" / "queries" / utm_name(480_100, 4_880_000))
    base = open_evaluation_set(tmp_path / "a").fingerprint
    others = {
        open_evaluation_set(tmp_path / "b").fingerprint,
        open_evaluation_set(tmp_path / "c").fingerprint,
        open_evaluation_set(tmp_path / "a", rule="radius 100").fingerprint,
        open_evaluation_set(tmp_path / "a", protocol="vme").fingerprint,
    }
    assert len(others | {base}) == 5
    assert open_evaluation_set(tmp_path / "d").fingerprint == base


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
def test_npy_lists_keep_their_order_and_their_ground_truth(tmp_path: Path, end: str) -> None:
    database, queries = npy_set(tmp_path / "SF_XS", end)
    opened = open_evaluation_set(tmp_path / "SF_XS", "sfxs_val")
    assert names(opened) == (database, queries)
    assert rows(opened) == [[0, 2], []]
    assert opened.rule == f"given by sfxs_val{end}.npy"
    assert all(photo.path.is_file() for photo in (*opened.database, *opened.queries))
    assert rows(open_evaluation_set(tmp_path / "SF_XS", rule="radius")) == [[2], [1]]


def test_a_ground_truth_belongs_to_its_lists_and_without_one_names_have_positions(
    tmp_path: Path,
) -> None:
    database, queries = npy_set(tmp_path)
    truth = tmp_path / "sfxs_val_gtImages.npy"
    truth.unlink()
    opened = open_evaluation_set(tmp_path, "sfxs_val")
    assert (rows(opened), opened.rule) == ([[2], [1]], "radius 25 m")
    positives = [np.array([0]), np.array([1])]
    write_ground_truth(truth, positives, database=database, queries=queries, rule="frames 2")
    opened = open_evaluation_set(tmp_path, "sfxs_val")
    assert (rows(opened), opened.rule) == ([[0], [1]], "frames 2")
    save_names(tmp_path / "sfxs_val_dbImages.npy", sorted(database))
    with refused("ground_truth_of_other_lists"):
        open_evaluation_set(tmp_path, "sfxs_val")
    (tmp_path / "sfxs_val_qImages.npy").unlink()
    with refused("bad_list", r"sfxs_val_qImages\.npy"):
        open_evaluation_set(tmp_path, "sfxs_val")


def test_lists_may_lie_apart_from_their_photos(tmp_path: Path) -> None:
    database, _ = npy_set(tmp_path / "lists")
    (tmp_path / "lists" / "val").rename(tmp_path / "val")
    opened = open_evaluation_set(tmp_path / "lists")
    assert opened.database[0].path == tmp_path / database[0] == opened.database[0].path.resolve()


def test_sped_has_a_table_of_integers_and_msls_a_selection_of_queries(tmp_path: Path) -> None:
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


def write_bench(base: Path, truth: list[tuple[Any, Any]]) -> Path:
    """Eleven reference photos and three queries of VPR-Bench."""
    write_photos(base / "ref", [f"{number}.jpg" for number in range(11)])
    write_photos(base / "query", [f"{number:07d}.jpg" for number in range(3)])
    table = np.empty((len(truth), 2), object)
    for row, (query, positives) in enumerate(truth):
        table[row, 0], table[row, 1] = query, positives
    np.save(base / "ground_truth_new.npy", table, allow_pickle=True)
    return base


def test_photos_of_vpr_bench_are_in_numeric_order_and_rows_belong_to_their_query(
    tmp_path: Path,
) -> None:
    bench = write_bench(tmp_path / "Corridor", [(2, [10, 9]), (0, np.array([2, 3]))])
    assert evaluation_set_names(tmp_path) == ("corridor",)
    opened = open_evaluation_set(bench)
    assert names(opened)[0] == [f"ref/{number}.jpg" for number in range(11)]
    assert names(opened)[1] == [f"query/{number:07d}.jpg" for number in range(3)]
    assert rows(opened) == [[2, 3], [], [9, 10]]
    assert opened.rule == "given by ground_truth_new.npy"
    assert rows(open_evaluation_set(bench, rule="frames 1")) == [[0, 1], [0, 1, 2], [1, 2, 3]]


def test_numbered_frames_in_folders_need_no_table(tmp_path: Path) -> None:
    write_photos(tmp_path / "database", [f"frame_{number:04d}.jpg" for number in (5, 6, 20)])
    write_photos(tmp_path / "queries", ["img-7.jpg"])
    assert rows(open_evaluation_set(tmp_path, rule="frames 2")) == [[0, 1]]


@pytest.mark.parametrize(
    ("summer", "winter", "positives", "paired_by"),
    [
        (["image-{:05d}.png"], ["image-{:05d}.png"], [[1], [2], [3], [4]], "number in their names"),
        (["2013_{:03d}_640.png"], ["snow/{}.png"], [[1], [2], [3], [4]], "number in their names"),
        (["{:02d}_summer.png"], ["winter-{}00.png"], [[0], [1], [2], [3]], "position"),
        (["a/7.png", "b/7.png"], ["7.png"], [[0]], "position"),
    ],
)
def test_seasons_are_paired_by_the_numbers_in_their_names_where_both_have_them(
    summer: list[str], winter: list[str], positives: list[list[int]], paired_by: str, tmp_path: Path
) -> None:
    """Summer has the photos 0 to 5, winter 1 to 4."""
    for season, names_, numbers in (("summer", summer, range(6)), ("winter", winter, range(1, 5))):
        if len(summer) == 1:
            names_ = [names_[0].format(number) for number in numbers]
        write_photos(tmp_path / season, names_)
    assert rows(open_evaluation_set(tmp_path, rule="frames 0")) == positives
    assert paired_by in (open_evaluation_set(tmp_path).paired_by or "")


def test_a_rule_counts_frames_where_the_names_of_seasons_count_in_tens(tmp_path: Path) -> None:
    write_photos(tmp_path / "summer", [f"{10 * number:05d}.png" for number in range(6)])
    write_photos(tmp_path / "winter", [f"{10 * number:05d}.png" for number in (1, 2, 4)])
    found = rows(open_evaluation_set(tmp_path, rule="frames 1"))
    assert found == [[0, 1, 2], [1, 2, 3], [3, 4, 5]]


@pytest.mark.parametrize(
    ("truth", "code"),
    [
        ([(3, [0])], "ground_truth_of_other_lists"),
        ([(0, [11])], "ground_truth_of_other_lists"),
        ([(0, [-1])], "bad_ground_truth"),
        ([([0, 1], [1])], "bad_ground_truth"),
    ],
)
def test_a_vpr_bench_ground_truth_of_other_photos_is_refused(
    truth: list[tuple[Any, Any]], code: str, tmp_path: Path
) -> None:
    with refused(code):
        open_evaluation_set(write_bench(tmp_path, truth))


@pytest.fixture
def msls(tmp_path: Path) -> Path:
    queries: dict[str, list[dict[str, Any]]] = {
        "cph": [
            {"key": "q0", "m": 0},
            {"key": "q1", "m": 30, "official": 20},
            {"key": "pano", "m": 0, "pano": True},
            {"key": "notask", "m": 0, "all": False},
            {"key": "far", "m": 900},
        ],
        "sf": [{"key": "q5", "m": 5000}],
    }
    for city, start in (("cph", 0), ("sf", 5000)):
        database: list[dict[str, Any]] = [
            {"key": f"{city}0", "m": start},
            {"key": f"{city}1", "m": start + 100},
            {"key": f"{city}pano", "m": start, "pano": True},
        ]
        msls_city(tmp_path / "train_val" / city / "database", database)
        msls_city(tmp_path / "train_val" / city / "query", queries[city])
    return tmp_path


def test_msls_official_drops_panoramas_other_tasks_and_queries_without_positives(
    msls: Path,
) -> None:
    opened = open_evaluation_set(msls)
    assert (opened.name, opened.protocol) == ("msls_val", "msls-official")
    stems = [[photo.path.stem for photo in each] for each in (opened.database, opened.queries)]
    assert stems == [["cph0", "cph1", "sf0", "sf1"], ["q0", "q1", "q5"]]
    assert rows(opened) == [[0], [0], [2]]
    query = opened.queries[0]
    assert (query.heading, query.sequence, query.frame) == (10.0, "s1", 4)
    assert query.path.is_file()
    assert names(opened)[1][0] == "train_val/cph/query/images/q0.jpg"


def test_msls_vme_keeps_all_queries_and_measures_by_latitude_and_longitude(msls: Path) -> None:
    opened = open_evaluation_set(msls / "train_val", protocol="vme")
    assert [photo.path.stem for photo in opened.queries] == ["q0", "q1", "notask", "far", "q5"]
    assert rows(opened) == [[0], [], [0], [], [2]]
    assert open_evaluation_set(msls / "train_val").fingerprint != opened.fingerprint


def test_msls_of_one_city_or_of_mixed_versions_is_refused(msls: Path) -> None:
    cut = msls / "train_val" / "cph" / "query" / "subtask_index.csv"
    cut.write_text("\n".join(cut.read_text().splitlines()[:-1]))
    with refused("bad_table", "different versions"):
        open_evaluation_set(msls)
    (msls / "train_val" / "sf").rename(msls / "train_val" / "amman")
    with refused("city_missing", r"no city sf\. Available: amman, cph"):
        open_evaluation_set(msls)
