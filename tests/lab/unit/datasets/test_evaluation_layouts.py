"""Sets to measure on, in each layout that is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import utm
from PIL import Image
from PIL.ExifTags import GPS, IFD
from scipy.io import savemat

from lab.datasets.open_dataset import evaluation_set_names, open_evaluation_set
from shared.errors import InvalidRequest, NotFound
from tests.lab.unit.data_sets import (
    code_of,
    names,
    pair,
    rows,
    utm_name,
    write_csv,
    write_photo,
    write_photos,
)


def test_pair_of_folders_is_a_set_named_after_its_folder(tmp_path: Path) -> None:
    pair(tmp_path / "My-City", [0, 25, 100], [0, 50, 500])
    opened = open_evaluation_set(tmp_path / "My-City")
    assert (opened.name, opened.rule, opened.protocol) == ("mycity", "radius 25 m", "placewise")
    assert rows(opened) == [[0, 1], [1], []]
    assert opened.without_positives.tolist() == [2]
    assert opened.database[1].name == f"database/{utm_name(480_025, 4_880_000)}"


def test_splits_of_a_data_set_are_sets_and_so_are_several_data_sets(tmp_path: Path) -> None:
    pair(tmp_path / "SF_XS" / "val", [0], [0])
    pair(tmp_path / "SF_XS" / "test", [0], [0])
    pair(tmp_path / "tokyo_xs" / "images" / "test", [0], [10])
    assert evaluation_set_names(tmp_path) == ("sfxs_test", "sfxs_val", "tokyoxs_test")
    assert evaluation_set_names(tmp_path / "SF_XS") == ("sfxs_test", "sfxs_val")
    assert len(open_evaluation_set(tmp_path, "tokyoxs_test").queries) == 1
    with pytest.raises(InvalidRequest, match="sfxs_test, sfxs_val, tokyoxs_test") as caught:
        open_evaluation_set(tmp_path)
    assert code_of(caught) == "which_set"
    with pytest.raises(NotFound, match="Available: sfxs_test, sfxs_val") as missing:
        open_evaluation_set(tmp_path / "SF_XS", "sfxs_tset")
    assert code_of(missing) == "set_missing"


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


def test_data_sets_of_one_name_are_distinguished(tmp_path: Path) -> None:
    pair(tmp_path / "my-city", [0], [0])
    pair(tmp_path / "my_city", [0, 1], [0])
    assert evaluation_set_names(tmp_path) == ("mycity", "mycity_2")
    assert len(open_evaluation_set(tmp_path, "mycity_2").database) == 2


def test_at_sign_in_a_folders_name_means_nothing(tmp_path: Path) -> None:
    pair(tmp_path / "me@home@2024@x", [0, 100], [90])
    assert rows(open_evaluation_set(tmp_path / "me@home@2024@x")) == [[1]]


def test_order_is_that_of_the_names_whatever_the_disk_says(tmp_path: Path) -> None:
    pair(tmp_path, [300, 100, 200], [0])
    opened = open_evaluation_set(tmp_path)
    assert names(opened)[0] == sorted(names(opened)[0])
    assert [shot.easting for shot in opened.database] == [480_100, 480_200, 480_300]


def test_list_beside_a_folder_is_the_set_in_its_order(tmp_path: Path) -> None:
    pair(tmp_path, [0, 100, 200], [200])
    listed = [f"database/{utm_name(480_000 + m, 4_880_000)}" for m in (200, 0)]
    (tmp_path / "database_images_paths.txt").write_text("\n".join(listed) + "\n")
    opened = open_evaluation_set(tmp_path)
    assert names(opened)[0] == listed
    assert rows(opened) == [[0]]
    (tmp_path / "database_images_paths.txt").write_text("elsewhere.jpg\n")
    with pytest.raises(InvalidRequest) as caught:
        open_evaluation_set(tmp_path)
    assert code_of(caught) == "bad_list"


def test_vme_compares_metres_of_different_zones_as_it_always_did(tmp_path: Path) -> None:
    east = utm_name(480_000, 4_880_000).replace("@32@", "@33@")
    write_photos(tmp_path / "database", [east])
    write_photos(tmp_path / "queries", [utm_name(480_000, 4_880_000)])
    assert rows(open_evaluation_set(tmp_path)) == [[]]
    assert rows(open_evaluation_set(tmp_path, protocol="vme")) == [[0]]
    with pytest.raises(InvalidRequest, match="placewise, vme") as caught:
        open_evaluation_set(tmp_path, protocol="msls-official")
    assert code_of(caught) == "unknown_protocol"


def gps_photo(path: Path, latitude: float, longitude: float) -> None:
    def parts(degrees: float) -> tuple[float, float, float]:
        return int(degrees), int(degrees * 60) % 60, degrees * 3600 % 60

    exif = Image.Exif()
    exif[IFD.GPSInfo] = {
        GPS.GPSLatitudeRef: "N",
        GPS.GPSLatitude: parts(latitude),
        GPS.GPSLongitudeRef: "E",
        GPS.GPSLongitude: parts(longitude),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 6)).save(path, exif=exif)


def test_photos_of_a_camera_are_placed_by_their_exif(tmp_path: Path) -> None:
    gps_photo(tmp_path / "database" / "IMG_1.jpg", 44.07, 8.76)
    gps_photo(tmp_path / "database" / "IMG_2.jpg", 44.0702, 8.76)
    gps_photo(tmp_path / "queries" / "IMG_3.jpg", 44.0703, 8.76)
    opened = open_evaluation_set(tmp_path)
    assert rows(opened) == [[1]]
    assert opened.database[0].zone == "32T"


def test_folders_of_places_are_labels_where_nobody_knows_positions(tmp_path: Path) -> None:
    write_photos(tmp_path / "database", ["hall/1.jpg", "door/2.jpg", "hall/3.jpg"])
    write_photos(tmp_path / "queries", ["hall/9.jpg"])
    opened = open_evaluation_set(tmp_path)
    assert opened.rule == "place-label"
    assert rows(opened) == [[1, 2]]


def test_photos_without_position_or_place_are_an_error_that_says_what_helps(
    tmp_path: Path,
) -> None:
    write_photos(tmp_path / "database", ["1.jpg"])
    write_photos(tmp_path / "queries", ["2.jpg"])
    with pytest.raises(InvalidRequest, match="CSV or EXIF") as caught:
        open_evaluation_set(tmp_path)
    assert code_of(caught) == "no_positions"


def test_the_given_rule_is_used(tmp_path: Path) -> None:
    pair(tmp_path, [0, 30, 100], [0])
    assert rows(open_evaluation_set(tmp_path, rule="radius 100")) == [[0, 1, 2]]
    with pytest.raises(InvalidRequest) as caught:
        open_evaluation_set(tmp_path, rule="closeness")
    assert code_of(caught) == "unknown_rule"


def test_dbstruct_of_matlab_brings_names_metres_and_its_radius(tmp_path: Path) -> None:
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
    assert all(shot.path.is_file() for shot in (*opened.database, *opened.queries))
    savemat(tmp_path / "pitts30k_test.mat", {"other": struct})
    with pytest.raises(InvalidRequest, match="no dbStruct") as caught:
        open_evaluation_set(tmp_path, "pitts30k_test")
    assert code_of(caught) == "bad_dbstruct"


def test_csv_tables_place_photos_by_degrees_or_metres_over_zones(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.jpg")
    header = ("path", "latitude", "longitude", "heading", "place", "frame", "sequence", "weather")
    write_csv(
        tmp_path / "database.csv",
        header,
        [("a.jpg", 48, 11.9999, 370, "x", 3, "s", "rain"), ("b.jpg", 48, 12.1, "", "", "", "", "")],
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
    with pytest.raises(InvalidRequest, match="1 photos have no frame"):
        open_evaluation_set(tmp_path, rule="frames 2")


def test_photos_of_csv_tables_may_be_in_folders_of_the_same_names(tmp_path: Path) -> None:
    for role, name in (("database", "a.jpg"), ("queries", "q.jpg")):
        (tmp_path / role).mkdir()
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
        (("path", "latitude", "longitude"), ("a.jpg", 44, ""), "bad_table"),
        (("path", "latitude", "longitude"), ("a.jpg", 86, 8), "bad_coordinates"),
        (("path", "latitude", "longitude"), ("", 44, 8), "bad_table"),
        (("path", "easting", "northing", "zone"), ("a.jpg", 1, 2, "99Q"), "bad_coordinates"),
        (("path", "frame"), ("a.jpg", 1.5), "bad_table"),
        (("path",), ("@x@y@.jpg",), "bad_coordinates"),
    ],
)
def test_tables_that_can_not_be_understood_are_refused(
    tmp_path: Path, header: tuple[str, ...], row: tuple[object, ...], code: str
) -> None:
    write_csv(tmp_path / "database.csv", header, [row])
    write_csv(tmp_path / "queries.csv", ("path", "lat", "lon"), [("q.jpg", 44, 8)])
    with pytest.raises(InvalidRequest) as caught:
        open_evaluation_set(tmp_path)
    assert code_of(caught) == code


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


def test_folder_of_nothing_and_empty_folders_are_explained(tmp_path: Path) -> None:
    with pytest.raises(NotFound) as caught:
        open_evaluation_set(tmp_path)
    assert code_of(caught) == "no_evaluation_set"
    (tmp_path / "database").mkdir()
    (tmp_path / "queries").mkdir()
    with pytest.raises(InvalidRequest, match="no database photo") as empty:
        open_evaluation_set(tmp_path)
    assert code_of(empty) == "empty_set"
