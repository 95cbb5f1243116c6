"""`placewise export`: files that other programs read, written from a server's answers."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, UUID, uuid5

import numpy as np
import pytest
from rich.progress import Progress

from placewise.client import Client
from services.cli.export import PairNames, export_descriptors, export_geojson, export_pairs
from shared.errors import Conflict, InvalidRequest, NotFound
from tests.support.api_responses import (
    GENERATION,
    GENERATION_ID,
    PHOTO,
    PHOTO_ID,
    SIMILAR,
    STATS,
)
from tests.unit.client.test_client import FakeServer, running_server


@pytest.fixture
def server() -> Iterator[FakeServer]:
    with running_server() as made:
        yield made


@pytest.fixture
def client(server: FakeServer) -> Iterator[Client]:
    with Client(server.url) as made:
        yield made


def photo(name: str, role: str = "database", **about: Any) -> dict[str, Any]:
    return {
        **PHOTO,
        "image_id": str(photo_id(name)),
        "original_filename": name,
        "latitude": None,
        "role": role,
        **about,
    }


def photo_id(name: str) -> UUID:
    return uuid5(NAMESPACE_URL, name)


def will_list(server: FakeServer, *photos: dict[str, Any]) -> None:
    server.will_answer(200, {"images": list(photos), "next_cursor": None})


def will_find(server: FakeServer, *names: str, **estimate: Any) -> None:
    images = [{**photo(name), "similarity_score": 0.5} for name in names]
    estimate = {**SIMILAR["estimate"], **estimate}
    server.will_answer(200, {**SIMILAR, "similar_images": images, "estimate": estimate})


def refuse(server: FakeServer, code: str) -> None:
    server.will_answer(409, Conflict(code, "Not now.").as_problem())


def pairs_of(client: Client, names: PairNames = PairNames.FILENAME) -> tuple[str, dict[str, Any]]:
    file = io.BytesIO()
    report = export_pairs(client, file, 2, names, Progress(disable=True))
    return file.getvalue().decode(), report


def test_pairs_are_those_of_the_labelled_queries_best_match_first(
    server: FakeServer, client: Client
) -> None:
    will_list(server, photo("a.jpg"), photo("b.jpg"), photo("q.jpg", "query"))
    will_find(server, "b.jpg", "a.jpg")
    text, report = pairs_of(client)
    assert text == "q.jpg b.jpg\nq.jpg a.jpg\n"
    assert report == {"asked": 1, "pairs": 2, "passed_over": 0}
    assert "top_k=2" in server.requests[1][1]


def test_a_map_without_queries_pairs_its_own_photos_and_passes_over_what_waits(
    server: FakeServer, client: Client
) -> None:
    will_list(server, photo("a.jpg"), photo("b.jpg"))
    will_find(server, "b.jpg")
    refuse(server, "not_searchable")
    text, report = pairs_of(client, PairNames.ID)
    assert text == f"{photo_id('a.jpg')} {photo_id('b.jpg')}\n"
    assert report["passed_over"] == 1


@pytest.mark.parametrize(
    ("photos", "names", "remedy"),
    [
        (("a.jpg", "a.jpg"), PairNames.FILENAME, "--names path or --names id."),
        (("a b.jpg",), PairNames.FILENAME, "by ID: --names id."),
        (("a b.jpg",), PairNames.PATH, "by ID: --names id."),
    ],
)
def test_names_that_a_list_of_pairs_can_not_tell_apart_are_refused_with_names_that_it_can(
    server: FakeServer, client: Client, photos: tuple[str, ...], names: PairNames, remedy: str
) -> None:
    will_list(server, *(photo(name) for name in photos))
    with pytest.raises(InvalidRequest) as caught:
        pairs_of(client, names)
    assert caught.value.code == "ambiguous_names"
    assert caught.value.detail.endswith(remedy)


def test_pairs_name_photos_of_one_name_by_their_paths(server: FakeServer, client: Client) -> None:
    first = photo("1.jpg", relative_path="day-1/1.jpg")
    second = photo("1.jpg", relative_path="day-2/1.jpg")
    will_list(server, first, photo("2.jpg", "query", relative_path=None))
    server.will_answer(200, {**SIMILAR, "similar_images": [{**second, "similarity_score": 0.5}]})
    assert pairs_of(client, PairNames.PATH)[0] == "2.jpg day-2/1.jpg\n"


def test_geojson_has_longitude_first_and_an_estimate_for_each_query(
    server: FakeServer, client: Client
) -> None:
    server.will_answer(200, STATS)
    will_list(
        server,
        photo("a.jpg", latitude=45.5, longitude=7.25, tags=["é"]),
        photo("q.jpg", "query"),
    )
    will_find(server, "a.jpg", latitude=45.5, longitude=7.25, in_map=True)
    file = io.BytesIO()
    progress = Progress(disable=True)
    report = export_geojson(client, file, True, progress)
    assert progress.tasks[0].total == STATS["total_images"] + STATS["labelled_queries"]
    found = json.loads(file.getvalue())
    assert found["type"] == "FeatureCollection"
    one, query, estimate = found["features"]
    assert one["geometry"] == {"type": "Point", "coordinates": [7.25, 45.5]}
    assert one["properties"]["tags"] == ["é"]
    assert one["properties"]["relative_path"] == "Day 2/street.jpg"
    assert query["geometry"] is None
    assert estimate["properties"]["query"] == query["id"]
    assert estimate["geometry"]["coordinates"] == [7.25, 45.5]
    assert report == {"photos": 2, "estimates": 1, "passed_over": 0}


def test_geojson_of_an_empty_map_is_an_empty_collection(server: FakeServer, client: Client) -> None:
    server.will_answer(200, {**STATS, "total_images": 0})
    will_list(server)
    file = io.BytesIO()
    export_geojson(client, file, False, Progress(disable=True))
    assert json.loads(file.getvalue()) == {"type": "FeatureCollection", "features": []}


def tar_with(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for name, data in files.items():
            about = tarfile.TarInfo(name)
            about.size = len(data)
            tar.addfile(about, io.BytesIO(data))
    return buffer.getvalue()


def test_descriptors_of_the_active_generation_can_be_mapped_into_memory(
    server: FakeServer, client: Client, tmp_path: Path
) -> None:
    rows = np.arange(6, dtype=np.float32).reshape(3, 2)
    buffer = io.BytesIO()
    np.save(buffer, rows)
    server.will_answer(
        200,
        [
            {**GENERATION, "generation_id": PHOTO_ID, "state": "building"},
            GENERATION,
        ],
    )
    files = {
        "photos.csv": b"row\n",
        "names.txt": b"a\nb\nc\n",
        "descriptors.npy": buffer.getvalue(),
    }
    server.will_answer(200, tar_with(files))
    out = tmp_path / "new" / "folder"
    written = export_descriptors(client, out, None, Progress(disable=True))
    assert (written["rows"], written["dimension"]) == (3, 2)
    mapped = np.load(out / "descriptors.npy", mmap_mode="r")
    assert np.array_equal(mapped, rows)
    assert sorted(path.name for path in out.iterdir()) == sorted(files)
    assert server.requests[1][1] == f"/api/v1/generations/{GENERATION_ID}/descriptors"


def test_a_refused_export_leaves_no_file(
    server: FakeServer, client: Client, tmp_path: Path
) -> None:
    server.will_answer(404, NotFound("generation_not_found", "None.").as_problem())
    with pytest.raises(NotFound):
        export_descriptors(client, tmp_path, GENERATION_ID, Progress(disable=True))
    assert list(tmp_path.iterdir()) == []


def test_a_generation_that_is_no_id_is_refused_before_any_request(
    server: FakeServer, client: Client, tmp_path: Path
) -> None:
    with pytest.raises(InvalidRequest) as caught:
        export_descriptors(client, tmp_path, "../maps", Progress(disable=True))
    assert caught.value.code == "bad_id"
    assert server.requests == []
