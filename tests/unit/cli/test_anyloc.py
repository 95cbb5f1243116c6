"""Reading the predecessor's folder: every row that can be read, every photo that is there."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from services.cli.ingest.anyloc import AnylocPhotos, AnylocRow, read_anyloc_photos, read_anyloc_rows
from shared.errors import InvalidRequest
from tests.support.anyloc import AnylocInstallation


@pytest.fixture
def anyloc(tmp_path: Path) -> Iterator[AnylocInstallation]:
    made = AnylocInstallation(tmp_path / "anyloc-similarity-service")
    yield made
    made.close()


def one_row(anyloc: AnylocInstallation, **columns: Any) -> AnylocRow:
    anyloc.add("a.jpg", b"photo", **columns)
    [row] = read_anyloc_rows(anyloc.database)
    return row


def read(anyloc: AnylocInstallation) -> AnylocPhotos:
    return read_anyloc_photos(anyloc.database, anyloc.uploads)


def state_of(folder: Path) -> dict[Path, tuple[bytes, int]]:
    return {
        path: (path.read_bytes(), path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_row_keeps_its_name_its_time_in_utc_its_tags_and_its_metadata(
    anyloc: AnylocInstallation,
) -> None:
    row = one_row(anyloc, tags="night, rain", metadata_json='{"upload_ip": "unknown"}')
    assert row == AnylocRow(
        image_path="/app/app/uploads/a.jpg",
        name="original-a.jpg",
        tags=["night", "rain"],
        metadata={
            "upload_ip": "unknown",
            "anyloc_image_id": "id-of-a.jpg",
            "anyloc_upload_time": "2026-05-01T10:20:30+00:00",
        },
    )


@pytest.mark.parametrize(
    ("text", "tags"),
    [
        (None, []),
        ("null", []),
        ("night, rain ,night,,", ["night", "rain"]),
        ('["one, with a comma", 7, null]', ["one with a comma", "7"]),
        ('"night,rain"', ["night", "rain"]),
        ("[broken", ["[broken"]),
        (12, ["12"]),
    ],
)
def test_tags_are_a_json_list_or_separated_by_commas(
    anyloc: AnylocInstallation, text: object, tags: list[str]
) -> None:
    assert one_row(anyloc, tags=text).tags == tags


@pytest.mark.parametrize(
    ("text", "time"),
    [
        ("2026-05-01T12:20:30+02:00", "2026-05-01T10:20:30+00:00"),
        ("2026-05-01 10:20:30.5", "2026-05-01T10:20:30.500000+00:00"),
        ("yesterday", "yesterday"),
        ("0001-01-01T00:00:00+14:00", "0001-01-01T00:00:00+14:00"),
    ],
)
def test_times_become_utc_and_what_is_none_stays_as_it_is(
    anyloc: AnylocInstallation, text: str, time: str
) -> None:
    assert one_row(anyloc, upload_time=text).metadata["anyloc_upload_time"] == time


@pytest.mark.parametrize("text", ["[1, 2]", "{broken", '{"a": NaN}', "[" * 100_000])
def test_metadata_that_is_no_json_object_is_kept_as_text(
    anyloc: AnylocInstallation, text: str
) -> None:
    assert one_row(anyloc, metadata_json=text).metadata["anyloc_metadata"] == text


def test_odd_values_cost_no_row(anyloc: AnylocInstallation) -> None:
    anyloc.connection.execute("ALTER TABLE images ADD COLUMN later_addition TEXT")
    anyloc.add("1.jpg", b"1", original_filename=None, upload_time=None, metadata_json=None)
    anyloc.add("2.jpg", b"2", original_filename=b"blob.jpg", tags=b"\xff\xfe")
    anyloc.add("3.jpg", b"3", original_filename="nul\0.jpg", image_id=None)
    anyloc.connection.execute("UPDATE images SET tags = CAST(x'c328' AS TEXT) WHERE tags IS NULL")
    names = [row.name for row in read_anyloc_rows(anyloc.database)]
    assert names == ["", "blob.jpg", "nul.jpg"]
    assert "" not in read_anyloc_rows(anyloc.database)[2].metadata
    assert [photo.name for photo in read(anyloc).photos] == ["1.jpg", "blob.jpg", "nul.jpg"]


def test_rows_in_the_write_ahead_log_of_a_read_only_folder_are_read_and_nothing_is_written(
    anyloc: AnylocInstallation,
) -> None:
    anyloc.add("a.jpg", b"photo")
    assert (anyloc.models / "similarity.db-wal").stat().st_size > 0
    before = state_of(anyloc.root)
    anyloc.models.chmod(0o500)
    try:
        assert len(read_anyloc_rows(anyloc.database)) == 1
        assert state_of(anyloc.root) == before
    finally:
        anyloc.models.chmod(0o700)


@pytest.mark.parametrize("broken", ["text", "empty", "cut off"])
def test_a_database_that_can_not_be_read_is_named(anyloc: AnylocInstallation, broken: str) -> None:
    for number in range(200):
        anyloc.add(f"{number}.jpg", None, tags="x" * 500)
    anyloc.close()
    whole = anyloc.database.read_bytes()
    damaged = {"text": b"This is no database." * 100, "empty": b"", "cut off": whole[:40_000]}
    anyloc.database.write_bytes(damaged[broken])
    with pytest.raises(InvalidRequest) as caught:
        read_anyloc_rows(anyloc.database)
    assert caught.value.code == "bad_anyloc_database"
    assert str(anyloc.database) in caught.value.detail


@pytest.mark.parametrize(
    "image_path",
    [
        "backend/app/uploads/a.jpg",
        "a.jpg",
        r"C:\service\backend\app\uploads\a.jpg",
    ],
)
def test_paths_of_other_machines_lead_to_the_file(
    anyloc: AnylocInstallation, image_path: str
) -> None:
    anyloc.add("a.jpg", b"photo", image_path=image_path)
    [photo] = read(anyloc).photos
    assert photo.path == anyloc.uploads / "a.jpg"
    assert photo.name == "original-a.jpg"


def test_files_of_one_name_are_distinguished_by_their_folders(anyloc: AnylocInstallation) -> None:
    (anyloc.uploads / "old").mkdir()
    (anyloc.uploads / "old" / "a.jpg").write_bytes(b"another photo")
    anyloc.add("a.jpg", b"photo")
    anyloc.add("old/a.jpg", None)
    assert [photo.path for photo in read(anyloc).photos] == [
        anyloc.uploads / "a.jpg",
        anyloc.uploads / "old" / "a.jpg",
    ]


def test_the_same_bytes_are_one_photo_that_remembers_the_others(anyloc: AnylocInstallation) -> None:
    anyloc.add("a.jpg", b"the same", tags="night")
    anyloc.add("b.jpg", b"the same", tags="rain,night")
    anyloc.add("c.jpg", b"not same", tags="rain")
    (anyloc.uploads / "d.jpg").write_bytes(b"the same")
    found = read(anyloc)
    assert [photo.name for photo in found.photos] == ["original-a.jpg", "original-c.jpg"]
    assert [item["filename"] for item in found.duplicates] == ["original-b.jpg", "d.jpg"]
    assert "original-a.jpg" in found.duplicates[0]["reason"]
    assert found.photos[0].fields["tags"] == "night,rain"
    others = json.loads(found.photos[0].fields["metadata"])["anyloc_same_photo"]
    assert [other["filename"] for other in others] == ["original-b.jpg", "d.jpg"]
    assert others[0]["anyloc_image_id"] == "id-of-b.jpg"
