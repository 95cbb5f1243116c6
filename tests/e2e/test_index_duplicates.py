"""`placewise index` of photos that are there already."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from tests.support.photos import photo_bytes
from tests.support.server import CommandLine, ServerProcess


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
