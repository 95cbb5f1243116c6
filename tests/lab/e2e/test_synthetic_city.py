"""`placewise datasets synth`: a city on disk, in the layouts of the field."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from lab.datasets.utm_names import parse_utm_file_name
from shared.utm_filenames import upload_fields_of_file_name
from tests.support.server import CommandLine

SYNTH = ("datasets", "synth")
SMALL = ("--places", "12", "--queries", "10", "--size", "96x72")
TINY = ("--places", "3", "--queries", "8", "--size", "64x64")
NOTE = "generated: not comparable with published figures"


@pytest.fixture(scope="module")
def placewise(tmp_path_factory: pytest.TempPathFactory) -> CommandLine:
    folder = tmp_path_factory.mktemp("city")
    return CommandLine(folder, folder / "home")


@pytest.fixture(scope="module")
def city(placewise: CommandLine) -> dict[str, Any]:
    """A small city and the output of the command."""
    answer: dict[str, Any] = placewise(*SYNTH, "out", *SMALL, "--json").json()
    return answer


@pytest.fixture
def out(placewise: CommandLine, city: dict[str, Any]) -> Path:
    assert city["out"] == "out"
    return placewise.folder / "out"


def contents(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_a_city_has_the_photos_that_are_counted_their_kinds_and_the_requested_size(
    city: dict[str, Any], out: Path
) -> None:
    assert city["counts"] == {"database": 48, "query": 10, "train": 48}
    assert city["query_kinds"] == {"in_map": 8, "other_way": 1, "out_of_map": 1}
    assert city["note"] == NOTE
    assert city["drawing"]["photos_per_second"] > 0
    photos = list(out.rglob("*.jpg"))
    assert len(photos) == 48 + 10 + 48
    for path in photos:
        fields = upload_fields_of_file_name(path.name, None)
        assert set(fields) == {"latitude", "longitude", "heading", "captured_at"}
        with Image.open(path) as image:
            assert (image.size, image.format) == ((96, 72), "JPEG")
    about = json.loads((out / "city.json").read_text())
    assert about["note"] == NOTE
    assert about["arguments"] == {
        "places": 12,
        "views": 4,
        "queries": 10,
        "seed": 0,
        "catalogue_seed": 0,
        "out_of_map": 0.1,
        "width": 96,
        "height": 72,
        "train": True,
        "ride_frames": 0,
    }
    assert len(list((out / "database").iterdir())) == 48
    assert set(about["queries"]) == {path.name for path in (out / "queries").iterdir()}
    kinds = [query["kind"] for query in about["queries"].values()]
    assert sorted(kinds) == ["in_map"] * 8 + ["other_way", "out_of_map"]


def test_gsv_xs_table_names_its_photos_by_place(out: Path) -> None:
    (table,) = (out / "gsv_xs" / "dataframes").iterdir()
    assert table.name == "synth0x0.csv"
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["place_id", "class_name", "UTMx", "UTMy", "filename"]
    assert {row["class_name"] for row in rows} == {"synth0x0"}
    photos = out / "gsv_xs" / "train" / "synth0x0"
    assert {row["filename"] for row in rows} == {path.name for path in photos.iterdir()}
    for row in rows:
        # As the field's own tools read it: the place stands before the `_` of the note.
        assert int(row["filename"].split("@")[-2].split("_")[0]) == int(row["place_id"])
        location = parse_utm_file_name(row["filename"])
        assert location is not None
        assert (location.east, location.north) == (float(row["UTMx"]), float(row["UTMy"]))
    assert min([row["place_id"] for row in rows].count(str(p)) for p in range(12)) >= 4


@pytest.mark.parametrize("option", ["--seed", "--catalogue-seed"])
def test_another_seed_gives_other_pictures(placewise: CommandLine, out: Path, option: str) -> None:
    other = placewise.folder / f"other{option}"
    placewise(*SYNTH, other, *TINY, option, "7", "--json").json()
    assert not set(contents(other).values()) & set(contents(out).values())


def test_folder_that_holds_anything_is_refused_and_left_alone(
    placewise: CommandLine, out: Path
) -> None:
    before = contents(out)
    refused = placewise(*SYNTH, out, *SMALL, "--json")
    assert "empty" in refused.refusal("out_not_empty")
    assert contents(out) == before


def test_folder_that_cannot_be_made_is_an_error_that_names_it(
    placewise: CommandLine, out: Path
) -> None:
    refused = placewise(*SYNTH, out / "city.json" / "in", *TINY, "--json")
    assert "city.json" in refused.refusal("out_unwritable")


@pytest.mark.parametrize("wrong", [("--places", "0"), *(("--size", s) for s in ("63x240", "320"))])
def test_impossible_numbers_are_refused_before_anything_is_written(
    placewise: CommandLine, wrong: tuple[str, str]
) -> None:
    run = placewise(*SYNTH, "never", *wrong)
    assert (run.code, "Traceback" in run.stderr) == (2, False)
    assert wrong[0].lstrip("-") in run.stderr or "WxH" in run.stderr
    assert not (placewise.folder / "never").exists()
