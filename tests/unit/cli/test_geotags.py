"""Where the photos of a folder were taken: `@UTM@` names, CSV tables and lists."""

from __future__ import annotations

import os
import unicodedata
from datetime import UTC, datetime
from errno import EACCES
from pathlib import Path
from unittest.mock import Mock

import pytest

from services.cli.ingest.geotags import (
    LocalPhoto,
    add_local_headers,
    count_other_files,
    find_local_sources,
    find_photos,
    list_photos,
    read_photo_manifest,
)
from services.cli.locate.sidecars import add_position
from shared.errors import InvalidRequest
from tests.support.photos import camera_exif, exif_with_position, photo_bytes

# The Mole Antonelliana in Turin, zone 32T.
EAST, NORTH = "396544.00", "4991543.00"


def make(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"a photo")
    return folder


def refused(folder: Path, table: Path | None = None, zone: str | None = None) -> InvalidRequest:
    with pytest.raises(InvalidRequest) as caught:
        find_photos(folder, table, zone)
    return caught.value


def table_of(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "photos.csv"
    path.write_text(text, encoding=encoding)
    return path


def test_photos_below_the_folder_are_sorted_by_path_and_hidden_files_are_left_out(
    tmp_path: Path,
) -> None:
    make(tmp_path, "b.JPG", "a/z.png", "a/b/c.webp", "notes.txt", "a/photos.csv", "c.tiff")
    make(tmp_path, ".b.jpg", "a/._a.jpg", ".hidden/a.jpg")
    found = find_photos(tmp_path, None, None)
    assert [photo.relative_path for photo in found] == ["a/b/c.webp", "a/z.png", "b.JPG", "c.tiff"]
    assert [photo.path for photo in found] == [tmp_path / str(p.relative_path) for p in found]
    [alone] = find_photos(tmp_path / "a" / "z.png", None, None)
    assert (alone.path, alone.relative_path) == (tmp_path / "a" / "z.png", "z.png")


def test_folder_that_cannot_be_read_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = PermissionError(EACCES, "Permission denied", str(tmp_path))
    monkeypatch.setattr(os, "scandir", Mock(side_effect=error))
    assert refused(tmp_path).code == "no_photos"
    assert f"{tmp_path}: Permission denied" in capsys.readouterr().err


def test_photos_and_folders_can_be_combined(tmp_path: Path) -> None:
    make(tmp_path, "a.jpg", "trip/b.jpg", "trip/notes.txt", "x[1]/2.JPG")
    paths = [tmp_path / name for name in ("a.jpg", "trip", "x[1]/2.JPG")]
    assert find_local_sources([*map(str, paths)]) == paths
    assert [count_other_files(path) for path in paths] == [{}, {".txt": 1}, {}]
    assert find_local_sources([str(tmp_path / "trip" / "notes.txt")]) is None
    assert find_local_sources(["s3://bucket/imports"]) is None


def test_coordinates_are_in_the_fields_or_in_the_exif(tmp_path: Path) -> None:
    plain, tagged = tmp_path / "plain.jpg", tmp_path / "tagged.jpg"
    plain.write_bytes(photo_bytes(1))
    tagged.write_bytes(photo_bytes(2, exif=exif_with_position(45.5, 7.25)))
    for without, photo in (
        (1, LocalPhoto(plain, {})),
        (0, LocalPhoto(plain, {"latitude": "45.5", "longitude": "7"})),
        (1, LocalPhoto(plain, {"latitude": "0.0", "longitude": "0"})),
        (0, LocalPhoto(tagged, {})),
    ):
        photos, report = add_local_headers([photo], None)
        assert report.without_coordinates == without
        assert photos == [photo], "the server reads the EXIF itself"


def test_folder_without_photos_is_an_error(tmp_path: Path) -> None:
    assert refused(make(tmp_path, "notes.txt", ".hidden.jpg")).code == "no_photos"


def test_table_with_a_byte_order_mark_says_what_is_known_of_each_photo(tmp_path: Path) -> None:
    make(tmp_path, "a.jpg", "in/b.jpg", "c.jpg")
    table = table_of(
        tmp_path,
        'filename,latitude,longitude,place,tags\na.jpg,45.1,7.6,,"night,rain"\nin/b.jpg,,,Café,\n',
        encoding="utf-8-sig",
    )
    found = {photo.path.name: photo.fields for photo in find_photos(tmp_path, table, None)}
    assert found == {
        "a.jpg": {"latitude": "45.1", "longitude": "7.6", "tags": "night,rain"},
        "b.jpg": {"place": "Café"},
        "c.jpg": {},
    }


def test_table_goes_before_the_name(tmp_path: Path) -> None:
    name = f"@{EAST}@{NORTH}@32@T@45.0@7.0@@@@@@@@@.jpg"
    make(tmp_path, name)
    table = table_of(tmp_path, f"file,latitude,longitude\n{name},1,2\n")
    assert find_photos(tmp_path, table, None)[0].fields == {"latitude": "1", "longitude": "2"}


def test_table_that_names_a_missing_photo_is_an_error_with_its_line(tmp_path: Path) -> None:
    make(tmp_path, "a.jpg")
    table = table_of(tmp_path, 'filename,place\na.jpg,"two\nlines"\n\nmissing.jpg,hall\n')
    error = refused(tmp_path, table)
    assert error.code == "bad_table"
    assert "line 5" in error.detail
    assert "missing.jpg" in error.detail
    assert refused(tmp_path, tmp_path / "nothing.csv").code == "bad_table"
    assert "line 2" in refused(tmp_path, table_of(tmp_path, "place,filename\nhall\n")).detail


def test_names_in_a_table_may_be_composed_otherwise_or_have_backslashes(tmp_path: Path) -> None:
    decomposed = unicodedata.normalize("NFD", "Zürich/é.jpg")
    make(tmp_path, decomposed, "day 1/a.jfif", "b.jpe")
    rows = "Zürich\\é.jpg,day\nday 1\\a.jfif,night\nb.jpe,rain\n"
    photos = find_photos(tmp_path, table_of(tmp_path, f"filename,tags\n{rows}"), None)
    assert {photo.path.name: photo.fields["tags"] for photo in photos} == {
        Path(decomposed).name: "day",
        "a.jfif": "night",
        "b.jpe": "rain",
    }


def test_copies_come_after_their_originals(tmp_path: Path) -> None:
    names = ["a.jpg", "a (1).jpg", "a (2).jpg", "a (10).jpg", "a1.jpg"]
    make(tmp_path, *names, ".hidden/new/a.jpg")
    assert [path.name for path in list_photos(tmp_path)] == names


def test_sidecars_and_the_zone_of_the_camera_add_what_the_photos_lack(tmp_path: Path) -> None:
    exif = camera_exif(datetime(2026, 5, 1, 12, tzinfo=UTC), model="Camera")
    at = datetime(2026, 5, 1, 12, 10, tzinfo=UTC)
    zoned = camera_exif(at, offset="+02:00", model="Camera")
    (tmp_path / "1.jpg").write_bytes(photo_bytes(1, exif=exif))
    (tmp_path / "1.xmp").write_bytes(add_position(None, 45.5, 7.25, 10.0))
    (tmp_path / "2.jpg").write_bytes(photo_bytes(2, exif=zoned))
    (tmp_path / "2.jpg.xmp").write_bytes(b"no XML")
    found = find_photos(tmp_path, None, None)
    photos, report = add_local_headers(found, None)
    assert [photo.fields for photo in photos] == [
        {"latitude": "45.5", "longitude": "7.25", "captured_at": "2026-05-01T10:00:00+00:00"},
        {},
    ]
    assert [each["reason"] for each in report.not_understood] == ["its XMP is damaged"]
    photos, _ = add_local_headers(find_photos(tmp_path / "1.jpg", None, None), "+05:00")
    assert photos[0].fields["captured_at"] == "2026-05-01T07:00:00+00:00"


SCREENSHOT = "Screenshot_20230101-123456_Chrome.jpg"
LONG = "a" * 43 + ".jpg"  # 47 characters, of which Takeout keeps 46


@pytest.mark.parametrize(
    ("photo", "sidecar", "is_its_own"),
    [
        ("1.jpg", "1.jpg.json", True),
        ("1.jpg", "1.jpg.supplemental-metadata.json", True),
        (SCREENSHOT, f"{SCREENSHOT}.suppleme.json", True),
        ("1(2).jpg", "1.jpg(2).json", True),
        ("1(2).jpg", "1.jpg.supplemental-metadata(2).json", True),
        (LONG, "a" * 43 + ".jp.json", True),
        ("1.jpg", "1.jpg(2).json", False),
        ("1(2).jpg", "1.jpg.json", False),
        ("1.jpg", "1.json", False),
    ],
)
def test_the_json_of_google_takeout_is_a_sidecar_under_all_its_names(
    photo: str, sidecar: str, is_its_own: bool, tmp_path: Path
) -> None:
    (tmp_path / photo).write_bytes(photo_bytes(1))
    (tmp_path / sidecar).write_text(
        '{"title": "1.jpg", "photoTakenTime": {"timestamp": "1714557600"}, "geoData": '
        '{"latitude": -33.85, "longitude": 151.2, "altitude": 0.0, "latitudeSpan": 0.0}}'
    )
    [found], report = add_local_headers(find_photos(tmp_path, None, None), None)
    expected = ["-33.85", "151.2", "2024-05-01T10:00:00+00:00"] if is_its_own else []
    assert [*found.fields.values()] == expected
    assert report.without_coordinates != is_its_own


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"geoData": {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}}', None),
        ('{"geoData": {"latitude": "x"}, "photoTakenTime": {"timestamp": "9e99"}}', None),
        ('[{"SourceFile": "1.jpg"}]', None),
        ('{"geoData": {"latitude": 1', "its JSON is damaged"),
    ],
)
def test_json_without_a_place_adds_nothing(text: str, reason: str | None, tmp_path: Path) -> None:
    (tmp_path / "1.jpg").write_bytes(photo_bytes(1))
    (tmp_path / "1.jpg.json").write_text(text)
    [found], report = add_local_headers(find_photos(tmp_path, None, None), None)
    assert found.fields == {}
    assert [each["reason"] for each in report.not_understood] == ([reason] if reason else [])


def test_a_list_that_names_a_missing_photo_is_refused_by_its_line(tmp_path: Path) -> None:
    (tmp_path / "1.jpg").write_bytes(b"one")
    data = b'{"filename": "1.jpg"}\n{"filename": "2.jpg"}\n'
    with pytest.raises(InvalidRequest) as caught:
        read_photo_manifest(tmp_path / "list.jsonl", data)
    assert caught.value.code == "bad_manifest"
    assert [error["line"] for error in caught.value.extra["errors"]] == [2]
