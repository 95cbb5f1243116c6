"""Batches as a user sees them: over HTTP, by the command line, in one process and in several."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from placewise.client import Client
from shared.errors import InvalidRequest
from tests.support.archives import zip_of
from tests.support.photos import photo_bytes
from tests.support.server import CommandLine, ServerProcess

SETTINGS = {"max_file_size": 100_000}


def photos(*numbers: int) -> dict[str, bytes]:
    return {f"{number}.jpg": photo_bytes(number) for number in numbers}


def table(*numbers: int) -> bytes:
    rows = (f"{number}.jpg,{45 + number / 1000},7\n" for number in numbers)
    return ("filename,latitude,longitude\n" + "".join(rows)).encode()


@pytest.fixture
def client(server: ServerProcess) -> Iterator[Client]:
    with Client(str(server.client.base_url)) as opened:
        yield opened


def test_the_client_sends_files_with_a_manifest_and_names_of_objects(
    client: Client, server: ServerProcess, tmp_path: Path
) -> None:
    paths = []
    for name, data in photos(120, 121).items():
        paths.append(tmp_path / name)
        paths[-1].write_bytes(data)
    started = client.upload_files(paths, [{"filename": "121.jpg", "place": "hall"}])
    client.wait(started)
    one, two = client.batch_items(started)
    assert one.file_id is not None
    assert two.file_id is not None
    assert client.photo(one.file_id).place is None
    assert client.photo(two.file_id).place == "hall"

    imports = server.home / "objects" / "imports"
    imports.mkdir()
    (imports / "a.jpg").write_bytes(photo_bytes(122))
    started = client.import_objects([{"key": "imports/a.jpg"}, {"key": "imports/b.jpg"}])
    job = client.wait(started)
    assert job.progress.as_json() == {"done": 1, "total": 2, "failed": 1}
    [failed] = client.batch_items(started, "failed")
    assert failed.error is not None
    assert failed.error["code"] == "object_not_found"
    with pytest.raises(InvalidRequest, match="not below imports/"):
        client.import_objects([{"key": "originals/a.jpg"}])


def test_the_client_gives_places_and_restores_a_deleted_photo(
    client: Client, tmp_path: Path
) -> None:
    (tmp_path / "somewhere.jpg").write_bytes(photo_bytes(130))
    uploaded = client.upload(tmp_path / "somewhere.jpg")
    client.wait(uploaded)
    id_ = uploaded.file_id
    assert id_ in {each.photo.image_id for each in client.propose_places()}
    place = {"file_id": str(id_), "latitude": 45.5, "longitude": 7.5}
    assert client.give_places([place]).given == [id_]
    assert client.photo(id_).latitude == 45.5
    assert client.undo_places([id_]).restored == [id_]
    client.delete_photo(id_)
    assert id_ in {each.image_id for each in client.photos(removed=True)}
    assert client.restore_photo(id_).latitude is None


def index(server: ServerProcess, path: Path, *options: str, code: int = 0) -> dict[str, Any]:
    run = CommandLine(path.parent, server.home)("index", path, *options, "--json")
    report: dict[str, Any] = run.json(code)
    return report


def test_index_takes_an_archive_as_it_takes_a_folder(server: ServerProcess, tmp_path: Path) -> None:
    first = 140
    members = {f"trip/{name}": data for name, data in photos(*range(first, first + 4)).items()}
    members |= {"trip/bad.jpg": b"no photo", "trip/notes.txt": b"of the trip"}
    path = tmp_path / "photos"  # its name says nothing
    path.write_bytes(zip_of({**members, "trip/photos.csv": table(first)}))
    report = index(server, path, code=1)
    assert (report["photos"], report["uploaded"], report["already_there"]) == (5, 4, 0)
    assert (report["other_files"], report["without_coordinates"]) == (1, 3)
    [refused] = report["refused"]
    assert refused["path"].endswith("photos/trip/bad.jpg")
    assert "not a photo" in refused["reason"]
    found = server.ask(photo_bytes(first), top_k=1).json()["similar_images"][0]
    assert found["relative_path"] == f"trip/{first}.jpg"
    assert found["latitude"] == 45 + first / 1000

    report = index(server, path, code=1)
    assert (report["uploaded"], report["already_there"]) == (0, 4)
    assert [each.name for each in tmp_path.iterdir()] == ["photos"]


def test_index_takes_a_list_goes_on_after_a_break_and_names_what_failed(
    server: ServerProcess, tmp_path: Path
) -> None:
    for name, data in photos(170, 171).items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "bad.jpg").write_bytes(b"no photo")
    listed = tmp_path / "list.jsonl"
    names = ("170.jpg", "171.jpg", "bad.jpg")
    lines = [json.dumps({"filename": name, "place": "hall"}) for name in names]
    listed.write_text("\n".join(lines))
    report = index(server, listed, code=1)
    assert report["uploaded"] == 2
    [refused] = report["refused"]
    assert refused["path"].endswith("bad.jpg")
    found = server.ask(photo_bytes(171), top_k=1).json()["similar_images"][0]
    assert found["place"] == "hall"

    listed.write_text("\n".join(lines[:2]))
    report = index(server, listed)
    assert (report["uploaded"], report["already_there"]) == (0, 2)


def test_index_brings_in_a_list_of_keys(server: ServerProcess, tmp_path: Path) -> None:
    imports = server.home / "objects" / "imports" / "keys"
    imports.mkdir(parents=True)
    (imports / "180.jpg").write_bytes(photo_bytes(180))
    listed = tmp_path / "keys.jsonl"
    listed.write_text(json.dumps({"key": "imports/keys/180.jpg", "latitude": 45, "longitude": 7}))
    assert index(server, listed)["uploaded"] == 1
    refused = index(server, listed, "--update", code=1)
    assert refused["code"] == "unsupported_option"
