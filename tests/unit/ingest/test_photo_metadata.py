"""Form fields: what people say of a photo, and every error naming its field."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from shared.errors import Unprocessable
from shared.ingest.photo_metadata import (
    MAX_TAGS,
    MAX_TEXT_CHARACTERS,
    PhotoFields,
    parse_relative_path,
    read_form_fields,
)


def refused(form: dict[str, str]) -> Unprocessable:
    with pytest.raises(Unprocessable) as caught:
        read_form_fields(form)
    assert caught.value.code == "invalid_field"
    return caught.value


def refused_field(form: dict[str, str]) -> str:
    """The field that the error names for programs."""
    field: str = refused(form).extra["errors"][0]["field"]
    return field


def test_every_field_is_read() -> None:
    found = read_form_fields(
        {
            "latitude": " 45.07 ",
            "longitude": "-7.5",
            "altitude": "-3.5",
            "heading": "90",
            "captured_at": "2026-05-01T12:30:00+02:00",
            "place": "corridor 3",
            "tags": "night, indoor ,night,,",
            "metadata": '{"camera": {"f": 1.8}, "n": null}',
            "relative_path": "Day 2/IMG_2078.jpg",
        }
    )
    assert found == PhotoFields(
        latitude=45.07,
        longitude=-7.5,
        altitude=-3.5,
        heading=90.0,
        captured_at=datetime(2026, 5, 1, 10, 30, tzinfo=UTC),
        place="corridor 3",
        tags=["night", "indoor"],
        metadata={"camera": {"f": 1.8}, "n": None},
        relative_path="Day 2/IMG_2078.jpg",
    )


@pytest.mark.parametrize(
    ("sent", "stored"),
    [
        ("Day 2/IMG_2078.jpg", "Day 2/IMG_2078.jpg"),
        (r"C:\Users\me\Day 2\1.jpg", "Users/me/Day 2/1.jpg"),
        ("./../../etc//passwd", "etc/passwd"),
        ("/srv/1.jpg", "srv/1.jpg"),
        ("a\x00b/1\n.jpg", "ab/1.jpg"),
        ("../.", None),
    ],
)
def test_a_relative_path_is_a_label_below_its_folder(sent: str, stored: str | None) -> None:
    assert parse_relative_path(sent) == stored


def test_of_a_long_path_the_end_is_kept_as_a_label() -> None:
    path = parse_relative_path("deep/" * 300 + "1.jpg")
    assert path is not None
    assert len(path) == 1000
    assert path.endswith("/deep/1.jpg")
    for cut in ("/", "../", "x../", "C:/"):
        rest = "a" * (1000 - len(cut.removeprefix("x")))
        assert parse_relative_path(f"folder{cut}{rest}") == rest


def test_empty_and_missing_fields_are_left_out() -> None:
    empty = {"latitude": "", "place": "  ", "tags": "", "metadata": ""}
    assert read_form_fields(empty) == read_form_fields({}) == PhotoFields()


def test_unknown_field_is_refused_and_the_known_are_named() -> None:
    error = refused({"lattitude": "45"})
    assert error.extra["errors"][0]["field"] == "lattitude"
    assert "latitude" in error.detail


def test_invalid_coordinates_are_refused() -> None:
    for value in ("90.0001", "-91", "nan", "inf", "north", "45,07", "0x10"):
        assert refused_field({"latitude": value, "longitude": "0"}) == "latitude"
    for value in ("180.0001", "-181", "NaN", "-Infinity", "east"):
        assert refused_field({"latitude": "0", "longitude": value}) == "longitude"


@pytest.mark.parametrize(("latitude", "longitude"), [("90", "180"), ("-90", "-180"), ("0", "7")])
def test_coordinates_at_the_ends_of_their_ranges_are_accepted(
    latitude: str, longitude: str
) -> None:
    found = read_form_fields({"latitude": latitude, "longitude": longitude})
    assert (found.latitude, found.longitude) == (float(latitude), float(longitude))


@pytest.mark.parametrize("zero", ["0", "0.0", "-0.000", "0e5"])
def test_coordinates_0_0_count_as_missing(zero: str) -> None:
    found = read_form_fields({"latitude": zero, "longitude": zero})
    assert (found.latitude, found.longitude) == (None, None)


def test_coordinates_come_in_pairs() -> None:
    assert refused_field({"latitude": "45"}) == "longitude"
    assert refused_field({"longitude": "7"}) == "latitude"


def test_heading_is_between_0_and_360_and_full_circle_is_north() -> None:
    assert read_form_fields({"heading": "360"}).heading == 0.0
    assert read_form_fields({"heading": "359.5"}).heading == 359.5
    assert refused_field({"heading": "-1"}) == "heading"
    assert refused_field({"heading": "361"}) == "heading"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2026-05-01T12:30:00", datetime(2026, 5, 1, 12, 30, tzinfo=UTC)),
        ("2026-05-01T12:30:00Z", datetime(2026, 5, 1, 12, 30, tzinfo=UTC)),
        # A blank where an address had a plus.
        ("2026-05-01T12:30:00 02:00", datetime(2026, 5, 1, 10, 30, tzinfo=UTC)),
        ("2026-05-01T00:30:00-05:00", datetime(2026, 5, 1, 5, 30, tzinfo=UTC)),
        ("2026-05-01", datetime(2026, 5, 1, tzinfo=UTC)),
    ],
)
def test_times_become_utc(text: str, expected: datetime) -> None:
    assert read_form_fields({"captured_at": text}).captured_at == expected


@pytest.mark.parametrize("text", ["yesterday", "1714559400", "0001-01-01T00:00:00+05:00"])
def test_invalid_times_are_refused(text: str) -> None:
    assert refused_field({"captured_at": text}) == "captured_at"


def test_texts_are_limited_in_length_and_refused_with_nul() -> None:
    assert read_form_fields({"place": "x" * MAX_TEXT_CHARACTERS}).place == "x" * MAX_TEXT_CHARACTERS
    assert refused_field({"place": "x" * (MAX_TEXT_CHARACTERS + 1)}) == "place"
    assert refused_field({"tags": "a," + "x" * (MAX_TEXT_CHARACTERS + 1)}) == "tags"
    assert refused_field({"place": "a\0b"}) == "place"
    assert refused_field({"tags": "a\0b"}) == "tags"


def test_the_number_of_tags_is_limited() -> None:
    many = ",".join(str(number) for number in range(MAX_TAGS))
    assert len(read_form_fields({"tags": many}).tags or ()) == MAX_TAGS
    assert refused_field({"tags": f"{many},one more"}) == "tags"


@pytest.mark.parametrize(
    "text",
    [
        *("{", "[]", "null", '{"a": NaN}', '{"a": -Infinity}', '{"a": 1e999}'),
        *('{"a": "\\u0000"}', '{"a\\u0000": 1}', '{"a": ["\\\\\\u0000"]}', '{"a": "\\ud800"}'),
        *("[" * 100_000, '{"a":' * 100_000, '{"a": ' + "9" * 5000 + "}"),
    ],
)
def test_metadata_that_no_json_column_can_hold_is_refused(text: str) -> None:
    assert refused_field({"metadata": text}) == "metadata"


@pytest.mark.parametrize("text", ['{"a": "\\\\u0000"}', '{"a": "\\ud83d\\ude00"}', "{}"])
def test_unusual_but_valid_metadata_is_kept(text: str) -> None:
    read_form_fields({"metadata": text})
