"""One photo: read, changed, shown, deleted; and photos found by what is known of them."""

from __future__ import annotations

import hashlib
import itertools
from datetime import datetime, timedelta, timezone
from typing import Any
from uuid import uuid4

import pytest

from tests.support.photos import photo_bytes
from tests.support.problems import field_refused, got, problem
from tests.support.server import ServerProcess

fresh = itertools.count(3000)


def url(file_id: str, part: str = "") -> str:
    return f"/api/v1/uploads/{file_id}{part}"


@pytest.fixture(scope="module")
def file_id(server: ServerProcess) -> str:
    """A photo that says everything of itself."""
    return server.indexed(
        photo_bytes(1),
        "yard.jpg",
        latitude=45.5,
        longitude=-7.25,
        altitude=238.5,
        heading=90,
        captured_at="2026-05-01T12:30:00+02:00",
        place="yard",
        tags="night,rain",
        metadata='{"camera": 7}',
    )


# --- one photo -------------------------------------------------------------------------------


def test_a_photo_has_all_its_metadata(server: ServerProcess, file_id: str) -> None:
    found = got(server.client.get(url(file_id)))
    uploaded, taken = found.pop("upload_time"), found.pop("captured_at")
    assert datetime.fromisoformat(uploaded).utcoffset() == timedelta(0)
    assert taken == "2026-05-01T10:30:00Z"
    job = got(server.client.get(f"/api/v1/jobs/{found.pop('job_id')}"))
    assert (job["file_id"], job["state"]) == (file_id, "succeeded")
    assert found == {
        "image_id": file_id,
        "image_path": url(file_id, "/image"),
        "image_url": url(file_id, "/image"),
        "thumbnail_url": url(file_id, "/thumbnail"),
        "preview_url": url(file_id, "/preview"),
        "original_filename": "yard.jpg",
        "relative_path": None,
        "file_size": len(photo_bytes(1)),
        "width": 64,
        "height": 48,
        "metadata": {"camera": 7},
        "tags": ["night", "rain"],
        "latitude": 45.5,
        "longitude": -7.25,
        "altitude": 238.5,
        "heading": 90,
        "focal_length": None,
        "given_place": None,
        "place": "yard",
        "role": "database",
        "media_type": "image/jpeg",
        "sha256": hashlib.sha256(photo_bytes(1)).hexdigest(),
        "searchable": True,
    }


@pytest.mark.parametrize(
    ("patch", "then", "cleared"),
    [
        (
            {"latitude": -33.5, "longitude": 151.25},
            {"latitude": -33.5, "longitude": 151.25},
            {"latitude": None, "longitude": None},
        ),
        ({"altitude": -1.5}, {"altitude": -1.5}, {"altitude": None}),
        ({"heading": 360}, {"heading": 0}, {"heading": None}),
        (
            {"captured_at": "2026-05-01T12:30:00-01:00"},
            {"captured_at": "2026-05-01T13:30:00Z"},
            {"captured_at": None},
        ),
        ({"place": "cellar"}, {"place": "cellar"}, {"place": None}),
        ({"tags": [" a ", "b", "a"]}, {"tags": ["a", "b"]}, {"tags": []}),
        ({"metadata": {"x": [1]}}, {"metadata": {"x": [1]}}, {"metadata": {}}),
    ],
)
def test_each_field_can_be_changed_and_null_clears_it(
    server: ServerProcess, patch: dict[str, Any], then: dict[str, Any], cleared: dict[str, Any]
) -> None:
    changed = server.indexed(photo_bytes(next(fresh)), latitude=1, longitude=2, place="here")
    before = got(server.client.get(url(changed)))

    assert got(server.client.patch(url(changed), json=patch)) == {**before, **then}
    assert got(server.client.get(url(changed))) == {**before, **then}
    assert got(server.client.patch(url(changed), json={})) == {**before, **then}

    nulls = dict.fromkeys(patch)
    assert got(server.client.patch(url(changed), json=nulls)) == {**before, **cleared}
    assert got(server.client.get(url(changed))) == {**before, **cleared}


@pytest.mark.parametrize(
    ("patch", "named"),
    [
        ({"latitude": 91}, "latitude"),
        ({"longitude": None}, "longitude"),
        ({"captured_at": "yesterday"}, "captured_at"),
        ({"place": "a\0b"}, "place"),
        ({"tags": [str(tag) for tag in range(51)]}, "tags"),
        ({"metadata": {"a": "\0"}}, "metadata"),
        ({"filename": "other.jpg"}, "filename"),
    ],
)
def test_a_bad_change_is_refused_by_name_and_changes_nothing(
    server: ServerProcess, file_id: str, patch: dict[str, Any], named: str
) -> None:
    before = got(server.client.get(url(file_id)))
    field_refused(server.client.patch(url(file_id), json={"place": "new", **patch}), named)
    assert got(server.client.get(url(file_id))) == before


def test_an_image_is_the_bytes_that_were_uploaded(server: ServerProcess) -> None:
    data = photo_bytes(next(fresh), "PNG")
    png = server.indexed(data, 'name;"quoted" ü.png')
    answer = server.client.get(url(png, "/image"))
    assert answer.status_code == 200
    assert answer.content == data
    assert answer.headers["content-type"] == "image/png"
    assert answer.headers["content-length"] == str(len(data))
    assert answer.headers["x-content-type-options"] == "nosniff"
    etag = answer.headers["etag"]
    assert etag == f'"{hashlib.sha256(data).hexdigest()}"'

    again = server.client.get(url(png, "/image"), headers={"If-None-Match": etag})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", etag)
    other = server.client.get(url(png, "/image"), headers={"If-None-Match": '"another"'})
    assert (other.status_code, other.content) == (200, data)


def test_a_deleted_photo_is_gone_from_every_call(server: ServerProcess) -> None:
    data = photo_bytes(next(fresh))
    gone = server.indexed(data, "gone.jpg")
    answer = got(server.client.delete(url(gone)))
    assert answer == {
        "success": True,
        "message": "The photo gone.jpg is deleted; it can be restored for 30 days.",
        "deleted_file_id": gone,
    }
    for refused in (
        server.client.get(url(gone)),
        server.client.patch(url(gone), json={"place": "x"}),
        server.client.delete(url(gone)),
        server.client.get(url(gone, "/image")),
        server.similar(gone),
    ):
        assert problem(refused, 404, "photo_not_found")["file_id"] == gone
    similar = got(server.ask(data, top_k=100))["similar_images"]
    assert gone not in {image["image_id"] for image in similar}
    found = got(server.client.get("/api/v1/search", params={"filename": "gone.jpg"}))
    assert (found["total_found"], found["images"]) == (0, [])

    again = server.indexed(data, "gone.jpg")
    assert again != gone
    assert server.client.get(url(again, "/image")).content == data


def test_unknown_photos_are_not_found(server: ServerProcess) -> None:
    for unknown in (str(uuid4()), "no-id-at-all"):
        problem(server.client.get(url(unknown)), 404, "photo_not_found")
        problem(server.client.patch(url(unknown), json={}), 404, "photo_not_found")
        problem(server.client.delete(url(unknown)), 404, "photo_not_found")
        problem(server.client.get(url(unknown, "/image")), 404, "photo_not_found")
        problem(server.client.get(url(unknown, "/thumbnail")), 404, "photo_not_found")
        problem(server.similar(unknown), 404, "photo_not_found")


# --- photos by what is known of them ---------------------------------------------------------

STREETS = 5


@pytest.fixture(scope="module")
def streets(server: ServerProcess) -> list[dict[str, Any]]:
    """STREETS photos, all tagged `street`, oldest first; the last one is a larger file."""
    made = []
    for number in range(STREETS):
        media = "BMP" if number == STREETS - 1 else "JPEG"
        tags = "street,even" if number % 2 == 0 else "street,odd,50%_off"
        name = f"Street_{number}.jpg"
        made.append(server.indexed(photo_bytes(next(fresh), media), name, tags=tags))
    return [got(server.client.get(url(made_id))) for made_id in made]


def names(server: ServerProcess, **params: Any) -> list[str]:
    """What a metadata search among the streets finds, sorted by name."""
    tags = ",".join(["street", *params.pop("tags", [])])
    body = got(server.client.get("/api/v1/search", params={"tags": tags, **params}))
    assert body["total_found"] == len(body["images"])
    assert body["next_cursor"] is None
    assert body["query_time_ms"] > 0
    return sorted(image["original_filename"] for image in body["images"])


def streets_named(*numbers: int) -> list[str]:
    return [f"Street_{number}.jpg" for number in numbers]


def test_photos_are_found_by_each_filter(
    server: ServerProcess, streets: list[dict[str, Any]]
) -> None:
    """tests/contract/catalog/test_photo_search.py has the conditions of each filter."""
    assert names(server, filename="STREET_3") == streets_named(3), "case is ignored"
    assert names(server, tags=["even"]) == streets_named(0, 2, 4)
    large = streets[-1]["file_size"]
    assert names(server, min_file_size=large) == streets_named(4)
    second = datetime.fromisoformat(streets[1]["upload_time"])
    elsewhere = second.astimezone(timezone(timedelta(hours=5))).isoformat()
    for reported in (elsewhere, second.replace(tzinfo=None).isoformat()):
        assert names(server, upload_before=reported) == streets_named(0, 1), reported
    assert names(server, upload_after=elsewhere, tags=["even"], max_file_size=large - 1) == (
        streets_named(2)
    )


def test_found_photos_are_read_newest_first_page_by_page_with_all_their_fields(
    server: ServerProcess, streets: list[dict[str, Any]]
) -> None:
    only_of_one = ("job_id", "media_type", "sha256", "searchable")
    expected = [{k: v for k, v in s.items() if k not in only_of_one} for s in reversed(streets)]
    params: dict[str, Any] = {"tags": "street", "limit": 2}
    sizes, read = [], []
    while True:
        page = got(server.client.get("/api/v1/search", params=params))
        assert page["total_found"] == STREETS
        sizes.append(len(page["images"]))
        read += page["images"]
        if page["next_cursor"] is None:
            break
        params["cursor"] = page["next_cursor"]
    assert sizes == [2, 2, 1]
    assert read == expected


@pytest.mark.parametrize(
    ("params", "named"),
    [
        ({"cursor": "bm8gdXVpZA=="}, "cursor"),
        ({"upload_after": "yesterday"}, "upload_after"),
        ({"min_file_size": "-1"}, "min_file_size"),
        ({"limit": "1001"}, "limit"),
        ({"filename": "a\0b"}, "filename"),
    ],
)
def test_a_bad_filter_is_refused_by_name(
    server: ServerProcess, params: dict[str, str], named: str
) -> None:
    field_refused(server.client.get("/api/v1/search", params=params), named)
