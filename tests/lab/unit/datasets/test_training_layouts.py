"""Places to learn from, in each layout that is known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from lab.datasets.dataset import TrainingSet
from lab.datasets.open_dataset import open_training_set
from shared.errors import InvalidRequest, NotFound, PlacewiseError
from tests.lab.unit.data_sets import utm_name, write_csv, write_photo, write_photos

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


def code_of(caught: pytest.ExceptionInfo[PlacewiseError]) -> str:
    return caught.value.code


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
    with pytest.raises(InvalidRequest) as caught:
        open_training_set(tmp_path)
    assert code_of(caught) == "missing_column"


def test_city_with_more_than_a_hundred_thousand_places_clashes_with_no_other(
    tmp_path: Path,
) -> None:
    gsv_xs(tmp_path, "a", {100_001: 2, 5: 2})
    gsv_xs(tmp_path, "b", {1: 2})
    found = [place.place_id for place in open_training_set(tmp_path).places]
    assert found == [5, 100_001, 1_000_001]


def test_missing_city_is_named_with_those_that_are_there(tmp_path: Path) -> None:
    gsv_xs(tmp_path, "osl", {1: 2})
    with pytest.raises(NotFound, match=r"no city London, Rome\. Available: osl") as caught:
        open_training_set(tmp_path, ["London", "osl", "Rome"])
    assert code_of(caught) == "city_missing"


def test_missing_column_is_named_with_those_that_are_there(tmp_path: Path) -> None:
    gsv_xs(tmp_path, "osl", {1: 2})
    write_csv(tmp_path / "dataframes" / "osl.csv", ("place_id", "file"), [(1, "a.jpg")])
    with pytest.raises(InvalidRequest, match=r"class_name, filename.*place_id, file") as caught:
        open_training_set(tmp_path)
    assert code_of(caught) == "missing_column"


@pytest.mark.parametrize(
    ("row", "fault"), [(("x", "osl", 1, 2, "a.jpg"), "line 2.*'x'"), ((1, "osl"), "cells")]
)
def test_bad_row_is_named_by_its_line(tmp_path: Path, row: tuple[object, ...], fault: str) -> None:
    gsv_xs(tmp_path, "osl", {1: 2})
    write_csv(tmp_path / "dataframes" / "osl.csv", GSV_XS, [row])
    with pytest.raises(InvalidRequest, match=fault) as caught:
        open_training_set(tmp_path)
    assert code_of(caught) == "bad_table"


def test_name_without_a_place_is_named_where_there_is_no_table(tmp_path: Path) -> None:
    gsv_xs(tmp_path, "osl", {1: 2}, table=False)
    write_photo(tmp_path / "train" / "osl" / utm_name(480_001, 4_880_000, note="winter"))
    with pytest.raises(InvalidRequest, match="4257_Bangkok") as caught:
        open_training_set(tmp_path)
    assert code_of(caught) == "no_place_in_name"


def test_too_few_photos_of_every_place_is_an_error(tmp_path: Path) -> None:
    gsv_xs(tmp_path, "osl", {1: 2, 2: 3})
    assert len(open_training_set(tmp_path, min_photos=3).places) == 1
    with pytest.raises(InvalidRequest, match="4 photos or more") as caught:
        open_training_set(tmp_path, min_photos=4)
    assert code_of(caught) == "no_places"


def gsv_cities(base: Path, rows: Sequence[tuple[object, ...]], names: list[str]) -> None:
    write_csv(base / "Dataframes" / "Bangkok.csv", GSV_CITIES, rows)
    write_photos(base / "Images" / "Bangkok", names)


def test_original_gsv_cities_finds_photos_by_their_rows(tmp_path: Path) -> None:
    gsv_cities(
        tmp_path,
        [
            (5, 2014, 7, 3, "Bangkok", 13.7, 100.5, "a_b-C_"),
            # As pandas writes columns in which a number was missing, and digits it has added.
            ("5.0", "2015.0", "11.0", "358.0", "Bangkok", "13.700000000000001", "100.50", "dd"),
        ],
        [
            "Bangkok_0000005_2014_07_003_13.7_100.5_a_b-C_.jpg",
            "Bangkok_0000005_2015_11_358_13.7_100.5_dd.jpg",
        ],
    )
    opened = open_training_set(tmp_path)
    (place,) = opened.places
    assert (opened.layout, place.city, place.place_id) == ("GSV-Cities", "Bangkok", 5)
    assert [photo.is_file() for photo in place.photos] == [True, True]


def test_photo_that_a_row_promises_and_no_file_keeps_is_named_as_it_would_be(
    tmp_path: Path,
) -> None:
    rows = [(5, 2014, 7, 3, "Bangkok", 13.7, 100.5, p) for p in ("x", "y")]
    gsv_cities(tmp_path, rows, ["Bangkok_0000005_2014_07_003_13.7_100.5_x.jpg"])
    (place,) = open_training_set(tmp_path).places
    assert place.photos[1].name == "Bangkok_0000005_2014_07_003_13.7_100.5_y.jpg"


def test_table_of_ones_own_photos_is_a_training_set(tmp_path: Path) -> None:
    rows = [("a/1.jpg", "hall", "x"), ("a/2.jpg", "hall", "x"), ("b.jpg", "door", "x")]
    rows += [("c.jpg", "door", ""), ("d.jpg", "door", "")]
    write_csv(tmp_path / "train.csv", ("path", "place", "city"), rows)
    opened = open_training_set(tmp_path, ["x", tmp_path.name])
    assert sizes(opened) == [("x", 1, 2), (tmp_path.name, 100_000, 2)]
    assert opened.places[0].photos == (tmp_path / "a/1.jpg", tmp_path / "a/2.jpg")


def test_folder_of_several_data_sets_is_looked_through(tmp_path: Path) -> None:
    gsv_xs(tmp_path / "gsv_xs", "osl", {1: 2})
    opened = open_training_set(tmp_path)
    assert (opened.root, opened.name) == (tmp_path / "gsv_xs", "gsv_xs")


def test_folder_without_places_says_what_would_be_one(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="gsv_xs") as caught:
        open_training_set(tmp_path)
    assert code_of(caught) == "no_training_set"
    with pytest.raises(NotFound) as caught:
        open_training_set(tmp_path / "nowhere")
    assert code_of(caught) == "no_data_set"


def test_fingerprint_depends_on_the_places_and_not_on_their_folder(
    tmp_path: Path,
) -> None:
    for folder, places in (("a", {1: 2, 2: 2}), ("b", {1: 2, 2: 2}), ("c", {1: 2, 2: 3})):
        gsv_xs(tmp_path / folder, "osl", places)
    one, same, other = (open_training_set(tmp_path / folder).fingerprint for folder in "abc")
    assert one == same != other
