"""Lists that say where many photos were taken: what they give, how they name their bad lines."""

from __future__ import annotations

import pytest

from shared.errors import InvalidRequest, PlacewiseError
from shared.ingest.photo_metadata import (
    MAX_REPORTED_LINES,
    ManifestEntry,
    escape_csv_text,
    read_csv_manifest,
    read_form_fields,
    read_jsonl_manifest,
)


def refused(data: bytes) -> PlacewiseError:
    with pytest.raises(InvalidRequest) as caught:
        read_jsonl_manifest(data, "the manifest")
    assert caught.value.code == "bad_manifest"
    return caught.value


def test_lines_give_the_forms_fields_by_the_photos_names() -> None:
    data = (
        b"\xef\xbb\xbf"
        b'{"filename": "a.jpg", "latitude": 45.5, "longitude": -7, "tags": ["x", "y"]}\n'
        b"\n"
        b'{"path": "in/b.jpg", "place": "h\xc3\xa4ll", "metadata": {"n": [1]}, "altitude": 3}\r\n'
        b'{"file": "c.jpg", "captured_at": "2026-05-01", "role": "query", "heading": null}'
    )
    reported = read_jsonl_manifest(data, "the manifest")
    assert reported == [
        ManifestEntry(1, "a.jpg", {"latitude": "45.5", "longitude": "-7", "tags": "x,y"}),
        ManifestEntry(3, "in/b.jpg", {"place": "häll", "metadata": '{"n": [1]}', "altitude": "3"}),
        ManifestEntry(4, "c.jpg", {"captured_at": "2026-05-01", "role": "query"}),
    ]
    fields = [read_form_fields(one.fields) for one in reported]
    assert (fields[0].latitude, fields[0].longitude, fields[0].tags) == (45.5, -7, ["x", "y"])
    assert fields[1].metadata == {"n": [1]}


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (b"{", "is not JSON"),
        (b"\xff\xfe", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        (b"3", "is not a JSON object"),
        (b"{}", "has no filename or file or path"),
        (b'{"file": 3}', "file is not a non-empty string"),
        (b'{"file": ""}', "file is not a non-empty string"),
        (b'{"file": "a\\u0000"}', "NUL"),
        (b'{"file": "a", "place": "\\ud800"}', "surrogate"),
        (b'{"file": "a", "lat": 3}', "lat is unknown; the known fields are latitude"),
        (b'{"file": "a", "latitude": true}', "latitude can't be true"),
        (b'{"file": "a", "latitude": [1]}', "latitude can't be [1]"),
        (b'{"file": "a", "tags": ["a,b"]}', "without commas"),
        (b'{"file": "a", "place": 3}', "place can't be 3"),
        (b'{"file": "first.jpg"}', "is already in line 1"),
    ],
)
def test_a_bad_line_is_named_with_its_number(line: bytes, why: str) -> None:
    error = refused(b'{"file": "first.jpg"}\n\n' + line + b'\n{"file": "last.jpg"}\n')
    assert [fault["line"] for fault in error.extra["errors"]] == [3]
    assert "the manifest, line 3: " in error.detail
    assert why in error.detail


def test_an_invalid_value_in_a_manifest_fails_its_photo_only() -> None:
    [reported] = read_jsonl_manifest(b'{"file": "a", "latitude": 95, "longitude": 7}', "a list")
    with pytest.raises(PlacewiseError, match="latitude"):
        read_form_fields(reported.fields)


def test_only_the_first_bad_lines_are_named() -> None:
    error = refused(b"oops\n" * 1000)
    assert len(error.extra["errors"]) == MAX_REPORTED_LINES


@pytest.mark.parametrize("text", ["=1+1", "+1.jpg", "-1.jpg", "@a", "\tx", "'=1", "''-1"])
def test_text_that_is_a_formula_in_a_spreadsheet_is_escaped_and_read_as_it_was(text: str) -> None:
    escaped = escape_csv_text(text)
    assert escaped == f"'{text}"
    [entry] = read_csv_manifest(f"file,place\n{escaped},{escaped}\n".encode(), "t")
    assert (entry.name, entry.fields) == (text, {"place": text})


def test_other_text_is_written_and_read_as_it_is() -> None:
    for text in ("a.jpg", "a=b", "'tis.jpg", "7-1", ""):
        assert escape_csv_text(text) == text
    [entry] = read_csv_manifest(b"file,latitude,place\n'tis.jpg,-45,'s hall\n", "t")
    assert (entry.name, entry.fields) == ("'tis.jpg", {"latitude": "-45", "place": "'s hall"})


@pytest.mark.parametrize("separator", [";", "\t"])
@pytest.mark.parametrize("first", ["", "sep=,\r\n", "SEP=,\n"])
def test_a_table_may_be_as_a_spreadsheet_and_its_user_write_it(separator: str, first: str) -> None:
    table = first + "Filename,LATITUDE ,tags\r\na.jpg,45|5,x\r\n,,\r\n"
    table = table.replace(",", separator)
    entry = ManifestEntry(3 if first else 2, "a.jpg", {"latitude": "45.5", "tags": "x"})
    assert read_csv_manifest(table.replace("|", ",").encode("utf-8-sig"), "t") == [entry]


@pytest.mark.parametrize(
    ("table", "why"),
    [
        (b"file,place\na.jpg,hall,more\n", "line 2: has too many columns"),
        (b"file,place\na.jpg,x\na.jpg,y\n", "line 3: 'a.jpg' is already in line 2"),
        (b"file,place\na.jpg,a\0b\n", ""),
        (b"file,lat\na.jpg,3\n", "lat are unknown"),
        (b"\xff\xfe", "Can't read"),
        (b"", "has no column filename"),
    ],
)
def test_a_table_that_can_not_be_understood_is_refused(table: bytes, why: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        read_csv_manifest(table, "photos.csv")
    assert caught.value.code == "bad_table"
    assert "photos.csv" in caught.value.detail
    assert why in caught.value.detail
