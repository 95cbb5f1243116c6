"""`placewise index` of photos that are there already, and of the predecessor's with their names."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.support.anyloc import AnylocInstallation
from tests.support.photos import photo_bytes
from tests.support.server import CommandLine, Run, ServerProcess


@pytest.fixture(scope="module")
def anyloc(tmp_path_factory: pytest.TempPathFactory) -> AnylocInstallation:
    """Five rows: a photo twice, one without its file, and a text; and a photo that no row names."""
    made = AnylocInstallation(tmp_path_factory.mktemp("anyloc"))
    made.add(
        "5f0e.jpg",
        photo_bytes(10),
        original_filename="Piazza Castello.jpg",
        tags='["night", "rain"]',
        metadata_json='{"camera": "left"}',
    )
    made.add("7a31.png", photo_bytes(11, "PNG"), original_filename="hall.png")
    made.add("99b2.jpg", photo_bytes(10), original_filename="castle-again.jpg")
    made.add("c4d5.jpg", None, original_filename="lost.jpg")
    made.add("text.jpg", b"Only text, named as a photo.", original_filename="[odd] name.jpg")
    (made.uploads / "unlisted.jpg").write_bytes(photo_bytes(12))
    return made  # still open: the last rows lie in the write-ahead log


def index(server: ServerProcess, anyloc: AnylocInstallation, cwd: Path, *options: str) -> Run:
    database = ("--anyloc", anyloc.database)
    return CommandLine(cwd, server.home)("index", anyloc.uploads, *database, *options)


def import_it(server: ServerProcess, anyloc: AnylocInstallation, cwd: Path) -> dict[str, Any]:
    report: dict[str, Any] = index(server, anyloc, cwd, "--json").json(1)  # not all came in
    return report


def images(server: ServerProcess, **filters: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = server.client.get("/api/v1/search", params=filters).json()[
        "images"
    ]
    return found


def test_photos_are_imported_and_found_by_their_original_names_and_others_are_named(
    server: ServerProcess, anyloc: AnylocInstallation, tmp_path: Path
) -> None:
    report = import_it(server, anyloc, tmp_path)
    assert (report["rows"], report["photos"], report["unlisted"]) == (5, 4, 1)
    assert (report["uploaded"], report["already_there"]) == (3, 0)
    assert [item["filename"] for item in report["missing"]] == ["lost.jpg"]
    assert [item["filename"] for item in report["duplicates"]] == ["castle-again.jpg"]
    assert [item["filename"] for item in report["refused"]] == ["[odd] name.jpg"]
    assert "JPEG" in report["refused"][0]["reason"]
    assert report["failed"] == []

    [castle] = images(server, filename="piazza castello")
    assert castle["original_filename"] == "Piazza Castello.jpg"
    assert castle["tags"] == ["night", "rain"]
    assert castle["metadata"]["camera"] == "left"
    assert castle["metadata"]["anyloc_image_id"] == "id-of-5f0e.jpg"
    assert castle["metadata"]["anyloc_upload_time"] == "2026-05-01T10:20:30+00:00"
    assert castle["metadata"]["anyloc_same_photo"][0]["filename"] == "castle-again.jpg"
    assert len(images(server, filename="hall.png")) == 1
    assert len(images(server, filename="unlisted.jpg")) == 1
    assert [photo["original_filename"] for photo in images(server, tags="rain,night")] == [
        "Piazza Castello.jpg"
    ]
    # As `tags` matched in the old service: in part, in either case.
    assert images(server, tags_like="AI,nig") == images(server, tags="rain,night")
    assert images(server, tags="rai") == []
    similar = server.ask(photo_bytes(10), top_k=1).json()["similar_images"]
    assert similar[0]["original_filename"] == "Piazza Castello.jpg"

    again = import_it(server, anyloc, tmp_path)
    assert (again["uploaded"], again["already_there"]) == (0, 3)
    assert again["searchable"] == report["searchable"]
    shown = index(server, anyloc, tmp_path).stderr
    assert "4 photos processed, 3 already stored" in shown
    assert "5 database rows, 1 photos without one." in shown
    assert "1 missing:" in shown
    assert "[odd] name.jpg" in shown


def test_a_corrected_table_is_refused_by_name_and_taken_with_update(
    server: ServerProcess, tmp_path: Path
) -> None:
    (photos := tmp_path / "photos").mkdir()
    (photos / "0.jpg").write_bytes(photo_bytes(700))
    index = partial(CommandLine(tmp_path, server.home), "index", photos, "--json")
    assert index().code == 0
    rows = 'filename,latitude,longitude,captured_at,tags\n0.jpg,45,7,2026-05-01,"a,b"\n'
    (table := tmp_path / "places.csv").write_text(rows)
    reason = index("--csv", table).json(1)["refused"][0]["reason"]
    assert "latitude, longitude, captured_at, tags" in reason
    assert "--update" in reason

    report = index("--csv", table, "--update").json()
    assert (report["uploaded"], report["already_there"], report["refused"]) == (0, 1, [])
    [photo] = server.client.get("/api/v1/search", params={"near": "45,7,1"}).json()["images"]
    assert photo["tags"] == ["a", "b"]
    assert photo["captured_at"] == "2026-05-01T00:00:00Z"
    # Unchanged metadata is no difference.
    assert index("--csv", table).json()["already_there"] == 1
