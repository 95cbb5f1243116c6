"""`placewise index` of photos that are there already."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.support.photos import photo_bytes
from tests.support.server import CommandLine, ServerProcess


def index(server: ServerProcess, cwd: Path, *options: str | Path, code: int = 0) -> dict[str, Any]:
    run = CommandLine(cwd, server.home)("index", cwd / "photos", *options, "--json")
    report: dict[str, Any] = run.json(code)
    return report


def folder_of(tmp_path: Path, *photos: bytes) -> None:
    (tmp_path / "photos").mkdir()
    for number, photo in enumerate(photos):
        (tmp_path / "photos" / f"{number}.jpg").write_bytes(photo)


def table_of(tmp_path: Path, text: str) -> Path:
    table = tmp_path / "places.csv"
    table.write_text(text)
    return table


def test_a_corrected_table_is_refused_by_name_and_taken_with_update(
    server: ServerProcess, tmp_path: Path
) -> None:
    folder_of(tmp_path, photo_bytes(700))
    index(server, tmp_path)
    table = table_of(
        tmp_path, 'filename,latitude,longitude,captured_at,tags\n0.jpg,45,7,2026-05-01,"a,b"\n'
    )
    report = index(server, tmp_path, "--csv", table, code=1)
    reason = report["refused"][0]["reason"]
    assert "latitude, longitude, captured_at, tags" in reason
    assert "--update" in reason

    report = index(server, tmp_path, "--csv", table, "--update")
    assert (report["uploaded"], report["already_there"], report["refused"]) == (0, 1, [])
    [photo] = server.client.get("/api/v1/search", params={"near": "45,7,1"}).json()["images"]
    assert photo["tags"] == ["a", "b"]
    assert photo["captured_at"] == "2026-05-01T00:00:00Z"
    # Unchanged metadata is no difference.
    assert index(server, tmp_path, "--csv", table)["already_there"] == 1


def test_a_blank_where_an_address_had_a_plus_is_read_as_plus(server: ServerProcess) -> None:
    expected = "/api/v1/search?captured_after=2026-05-01T12:00:00+02:00"
    assert server.client.get(expected).status_code == 200
