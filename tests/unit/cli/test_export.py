"""`placewise export`: files that other programs read, written from a server's answers."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, UUID, uuid5

import numpy as np
import pytest
from typer.testing import CliRunner

from services.cli.export import app
from shared.errors import Conflict, NotFound, PlacewiseError
from tests.support.api_responses import GENERATION, GENERATION_ID, PHOTO, PHOTO_ID, SIMILAR, STATS
from tests.support.archives import tar_of
from tests.support.fake_server import FakeServer


def export(server: FakeServer, *arguments: str | Path) -> dict[str, Any]:
    """The report of the command; raises its error."""
    command = [*map(str, arguments), "--json", "--server", server.url]
    result = CliRunner().invoke(app, command)
    if isinstance(result.exception, PlacewiseError):
        raise result.exception
    assert result.exit_code == 0, result.output
    report: dict[str, Any] = json.loads(result.stdout)
    return report


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


def test_pairs_are_those_of_the_labelled_queries_best_match_first(
    server: FakeServer, tmp_path: Path
) -> None:
    out = tmp_path / "pairs.txt"
    will_list(server, photo("a.jpg"), photo("b.jpg"), photo("q.jpg", "query"))
    will_find(server, "b.jpg", "a.jpg")
    report = export(server, "pairs", "--out", out, "--top-k", "2")
    assert out.read_text() == "q.jpg b.jpg\nq.jpg a.jpg\n"
    assert report == {"file": str(out), "queries": 1, "pairs": 2, "skipped": 0}
    assert "top_k=2" in server.requests[1][1]


def test_a_map_without_queries_pairs_its_own_photos_but_those_without_a_descriptor(
    server: FakeServer, tmp_path: Path
) -> None:
    out = tmp_path / "pairs.txt"
    will_list(server, photo("a.jpg"), photo("b.jpg"))
    will_find(server, "b.jpg")
    server.will_answer(409, Conflict("not_searchable", "Not now.").as_problem())
    report = export(server, "pairs", "--out", out, "--names", "id")
    assert out.read_text() == f"{photo_id('a.jpg')} {photo_id('b.jpg')}\n"
    assert report["skipped"] == 1


@pytest.mark.parametrize(
    ("photos", "names", "remedy"),
    [
        (("a.jpg", "a.jpg"), "filename", "--names path or --names id."),
        (("a b.jpg",), "path", "by ID: --names id."),
    ],
)
def test_ambiguous_names_of_pairs_are_refused_with_the_option_that_separates_them(
    server: FakeServer, tmp_path: Path, photos: tuple[str, ...], names: str, remedy: str
) -> None:
    will_list(server, *(photo(name) for name in photos))
    with pytest.raises(PlacewiseError) as caught:
        export(server, "pairs", "--out", tmp_path / "pairs.txt", "--names", names)
    assert caught.value.code == "ambiguous_names"
    assert caught.value.detail.endswith(remedy)
    assert not list(tmp_path.iterdir())


def test_pairs_name_photos_of_one_name_by_their_paths(server: FakeServer, tmp_path: Path) -> None:
    first = photo("1.jpg", relative_path="day-1/1.jpg")
    second = photo("1.jpg", relative_path="day-2/1.jpg")
    will_list(server, first, photo("2.jpg", "query", relative_path=None))
    server.will_answer(200, {**SIMILAR, "similar_images": [{**second, "similarity_score": 0.5}]})
    export(server, "pairs", "--out", tmp_path / "pairs.txt", "--names", "path")
    assert (tmp_path / "pairs.txt").read_text() == "2.jpg day-2/1.jpg\n"


def test_geojson_has_longitude_first(server: FakeServer, tmp_path: Path) -> None:
    server.will_answer(200, STATS)
    will_list(
        server,
        photo("a.jpg", latitude=45.5, longitude=7.25, tags=["é"]),
        photo("q.jpg", "query"),
    )
    out = tmp_path / "map.geojson"
    report = export(server, "geojson", "--out", out)
    found = json.loads(out.read_text("utf-8"))
    assert found["type"] == "FeatureCollection"
    one, query = found["features"]
    assert one["geometry"] == {"type": "Point", "coordinates": [7.25, 45.5]}
    assert one["properties"]["tags"] == ["é"]
    assert one["properties"]["relative_path"] == "Day 2/street.jpg"
    assert query["geometry"] is None
    assert report == {"file": str(out), "photos": 2}


def test_geojson_of_an_empty_map_is_an_empty_collection(server: FakeServer, tmp_path: Path) -> None:
    server.will_answer(200, {**STATS, "total_images": 0})
    will_list(server)
    export(server, "geojson", "--out", tmp_path / "map.geojson")
    found = json.loads((tmp_path / "map.geojson").read_text())
    assert found == {"type": "FeatureCollection", "features": []}


def test_descriptors_of_the_active_generation_can_be_mapped_into_memory(
    server: FakeServer, tmp_path: Path
) -> None:
    rows = np.arange(6, dtype=np.float32).reshape(3, 2)
    buffer = io.BytesIO()
    np.save(buffer, rows)
    building = {**GENERATION, "generation_id": PHOTO_ID, "state": "building"}
    server.will_answer(200, [building, GENERATION])
    files = {
        "photos.csv": b"row\n",
        "names.txt": b"a\nb\nc\n",
        "descriptors.npy": buffer.getvalue(),
    }
    server.will_answer(200, tar_of(files))
    out = tmp_path / "new" / "folder"
    written = export(server, "descriptors", "--out", out)
    assert (written["rows"], written["dimension"]) == (3, 2)
    mapped = np.load(out / "descriptors.npy", mmap_mode="r")
    assert np.array_equal(mapped, rows)
    assert sorted(path.name for path in out.iterdir()) == sorted(files)
    assert server.requests[1][1] == f"/api/v1/generations/{GENERATION_ID}/descriptors"


def test_a_refused_export_leaves_no_file(server: FakeServer, tmp_path: Path) -> None:
    server.will_answer(404, NotFound("generation_not_found", "None.").as_problem())
    with pytest.raises(NotFound):
        export(server, "descriptors", "--out", tmp_path, "--generation", GENERATION_ID)
    assert list(tmp_path.iterdir()) == []
