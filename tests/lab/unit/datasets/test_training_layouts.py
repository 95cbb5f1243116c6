"""Places to learn from, in each layout that is known."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.datasets.dataset import TrainingSet
from lab.datasets.open_dataset import open_training_set
from tests.lab.unit.data_sets import refused, utm_name, write_csv, write_photo, write_photos

GSV_XS = ("place_id", "class_name", "UTMx", "UTMy", "filename")
GSV_CITIES = ("place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid")


def gsv_xs(base: Path, city: str, places: dict[int, int], *, table: bool = True) -> None:
    """So many photos of each place, each at its own metre."""
    rows = []
    for place, photos in places.items():
        for number in range(photos):
            name = utm_name(480_000 + place, 4_880_000 + number, note=f"{place}_{city}")
            write_photo(base / "train" / city / name)
            rows.append((place, city, 480_000 + place, 4_880_000 + number, name))
    if table:
        write_csv(base / "dataframes" / f"{city}.csv", GSV_XS, rows)


def sizes(opened: TrainingSet) -> list[tuple[str, int, int]]:
    return [(place.city, place.place_id, len(place.photos)) for place in opened.places]


@pytest.mark.parametrize("table", [True, False])
def test_gsv_xs_is_the_same_with_a_table_and_by_names_alone(tmp_path: Path, table: bool) -> None:
    gsv_xs(tmp_path, "osl", {3: 2, 1: 4, 2: 1}, table=table)
    gsv_xs(tmp_path, "bangkok", {1: 3}, table=table)
    opened = open_training_set(tmp_path)
    assert sizes(opened) == [("bangkok", 1, 3), ("osl", 100_001, 4), ("osl", 100_003, 2)]
    assert all(photo.is_file() for place in opened.places for photo in place.photos)
    assert (opened.layout, opened.cities, opened.photo_count) == ("gsv_xs", ("bangkok", "osl"), 9)


def test_cities_are_numbered_in_the_given_order_and_only_their_tables_are_read(
    tmp_path: Path,
) -> None:
    for city in ("osl", "bangkok", "trt"):
        gsv_xs(tmp_path, city, {7: 2})
    (tmp_path / "dataframes" / "trt.csv").write_text("broken")
    opened = open_training_set(tmp_path, ["OSL", "Bangkok", "osl"])
    assert sizes(opened) == [("osl", 7, 2), ("bangkok", 100_007, 2)]
    with refused("missing_column"):
        open_training_set(tmp_path)
    with refused("city_missing", r"no city London, Rome\. Available: bangkok, osl, trt"):
        open_training_set(tmp_path, ["London", "osl", "Rome"])


def test_city_with_more_than_a_hundred_thousand_places_clashes_with_no_other(
    tmp_path: Path,
) -> None:
    gsv_xs(tmp_path, "a", {100_001: 2, 5: 2})
    gsv_xs(tmp_path, "b", {1: 2})
    found = [place.place_id for place in open_training_set(tmp_path).places]
    assert found == [5, 100_001, 1_000_001]


@pytest.mark.parametrize(
    ("header", "row", "code", "message"),
    [
        (
            ("place_id", "file"),
            (1, "a.jpg"),
            "missing_column",
            "class_name, filename.*file",
        ),
        (GSV_XS, ("x", "osl", 1, 2, "a.jpg"), "bad_table", "line 2.*'x'"),
        (GSV_XS, (1, "osl"), "bad_table", "cells"),
    ],
)
def test_missing_columns_and_bad_rows_are_named(
    tmp_path: Path, header: tuple[str, ...], row: tuple[object, ...], code: str, message: str
) -> None:
    gsv_xs(tmp_path, "osl", {1: 2})
    write_csv(tmp_path / "dataframes" / "osl.csv", header, [row])
    with refused(code, message):
        open_training_set(tmp_path)


def test_name_without_a_place_is_named_where_there_is_no_table(tmp_path: Path) -> None:
    gsv_xs(tmp_path, "osl", {1: 2}, table=False)
    write_photo(tmp_path / "train" / "osl" / utm_name(480_001, 4_880_000, note="winter"))
    with refused("no_place_in_name", "4257_Bangkok"):
        open_training_set(tmp_path)


def test_too_few_photos_of_every_place_is_an_error(tmp_path: Path) -> None:
    gsv_xs(tmp_path, "osl", {1: 2, 2: 3})
    assert len(open_training_set(tmp_path, min_photos=3).places) == 1
    with refused("no_places", "4 photos or more"):
        open_training_set(tmp_path, min_photos=4)


def test_gsv_cities_finds_photos_by_their_rows_and_names_missing_ones(tmp_path: Path) -> None:
    table = [
        (5, 2014, 7, 3, "Bangkok", 13.7, 100.5, "a_b-C_"),
        # As pandas writes columns in which a number was missing, and digits it has added.
        ("5.0", "2015.0", "11.0", "358.0", "Bangkok", "13.700000000000001", "100.50", "dd"),
        (5, 2014, 7, 3, "Bangkok", 13.7, 100.5, "y"),
    ]
    names = [
        "Bangkok_0000005_2014_07_003_13.7_100.5_a_b-C_.jpg",
        "Bangkok_0000005_2015_11_358_13.7_100.5_dd.jpg",
    ]
    write_csv(tmp_path / "Dataframes" / "Bangkok.csv", GSV_CITIES, table)
    write_photos(tmp_path / "Images" / "Bangkok", names)
    opened = open_training_set(tmp_path)
    (place,) = opened.places
    assert (opened.layout, place.city, place.place_id) == ("GSV-Cities", "Bangkok", 5)
    missing = "Bangkok_0000005_2014_07_003_13.7_100.5_y.jpg"
    assert [photo.name for photo in place.photos] == [*names, missing]


def test_table_of_ones_own_photos_is_a_training_set(tmp_path: Path) -> None:
    rows = [("a/1.jpg", "hall", "x"), ("a/2.jpg", "hall", "x"), ("b.jpg", "door", "x")]
    rows += [("c.jpg", "door", ""), ("d.jpg", "door", "")]
    write_csv(tmp_path / "train.csv", ("path", "place", "city"), rows)
    opened = open_training_set(tmp_path, ["x", tmp_path.name])
    assert sizes(opened) == [("x", 1, 2), (tmp_path.name, 100_000, 2)]
    assert opened.places[0].photos == (tmp_path / "a/1.jpg", tmp_path / "a/2.jpg")


def test_training_set_may_be_one_of_several_data_sets_in_a_folder(tmp_path: Path) -> None:
    with refused("no_training_set", "gsv_xs"):
        open_training_set(tmp_path)
    with refused("no_data_set"):
        open_training_set(tmp_path / "nowhere")
    gsv_xs(tmp_path / "gsv_xs", "osl", {1: 2})
    opened = open_training_set(tmp_path)
    assert (opened.root, opened.name) == (tmp_path / "gsv_xs", "gsv_xs")


def test_fingerprint_depends_on_the_places_and_not_on_their_folder(
    tmp_path: Path,
) -> None:
    for folder, places in (("a", {1: 2, 2: 2}), ("b", {1: 2, 2: 2}), ("c", {1: 2, 2: 3})):
        gsv_xs(tmp_path / folder, "osl", places)
    one, same, other = (open_training_set(tmp_path / folder).fingerprint for folder in "abc")
    assert one == same != other
