"""A home whose catalog another version created: refused by name, and rebuilt as the error says."""

from __future__ import annotations

import hashlib
import shutil
import tarfile
from pathlib import Path

from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess, environment, run_command

# Made by the version with schema 0029: nine photos, of which one was deleted, in two maps.
ARCHIVE = Path(__file__).parents[1] / "support/files/home-of-schema-0029.tar.gz"


def hashes(home: Path) -> dict[str, str]:
    return {
        str(path.relative_to(home)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(home.rglob("*"))
        if path.is_file() and path.suffix not in (".lock", ".bin")
    }


def test_a_catalog_of_another_version_is_refused_by_name_and_rebuilt_from_its_store(
    tmp_path: Path,
) -> None:
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    home = tmp_path / "home"
    before = hashes(home)
    refused = run_command("serve", env=environment(home), cwd=tmp_path)
    assert refused.returncode != 0
    assert "schema_differs" in refused.stderr
    assert "schema 0029;" in refused.stderr
    assert f"move {home / 'catalog.sqlite'} (and its -wal and -shm files) away" in refused.stderr
    assert "placewise storage rebuild" in refused.stderr
    assert "Traceback" not in refused.stderr
    assert hashes(home) == before

    aside = tmp_path / "aside"
    aside.mkdir()
    for file in home.glob("catalog.sqlite*"):
        shutil.move(file, aside)
    rebuilt = run_command("storage", "rebuild", env=environment(home), cwd=tmp_path)
    assert rebuilt.returncode == 0, rebuilt.stderr
    with ServerProcess(home) as server:
        for name, count in (("default", 5), ("city", 3)):
            described = server.client.get(f"/api/v1/maps/{name}").json()
            assert (described["photos"], described["searchable"]) == (count, count)
        found = server.client.get("/api/v1/search").json()["images"]
        assert {image["place"] for image in found} <= {"room 0", "room 1", "room 2"}
        for number in range(5):
            best = server.ask(photo_bytes(number), top_k=1).json()["similar_images"][0]
            assert best["original_filename"] == f"photo{number}.jpg"
            assert best["similarity_score"] > 0.999
