"""Photos of role `query`: described like all others, used as queries, never found."""

from __future__ import annotations

from typing import Any
from uuid import UUID

import pytest

from services.extractor import fits
from services.extractor.fits import VocabularyFitRequest
from services.steward.tasks.compaction import merge_small_chunks
from shared.catalog.maps import increment_map_version, lock_map
from shared.catalog.photos import Photo, PhotoRole
from shared.config.settings import Settings
from tests.integration.harness import Harness
from tests.integration.in_process_api import Service
from tests.support.photos import near_copy, photo_bytes


def become(harness: Harness, role: PhotoRole, *photo_ids: UUID) -> None:
    """As `PATCH /uploads/{file_id}` does it."""
    with harness.catalog.write() as session:
        lock_map(session, harness.map_id)
        for photo_id in photo_ids:
            photo = session.get_one(Photo, photo_id)
            photo.role = role
            photo.changed_version = increment_map_version(session, harness.map_id)


def test_a_query_keeps_its_descriptor_through_merging_and_a_model_change(vlads: Harness) -> None:
    photo_ids = vlads.upload(0, 1, 2, 3)
    become(vlads, PhotoRole.QUERY, photo_ids[1])
    vlads.fit()
    old = vlads.active()
    more = vlads.upload(4, 5)
    become(vlads, PhotoRole.QUERY, more[0])
    vlads.drain()
    assert vlads.searchable() == 4
    before = vlads.rows()
    assert merge_small_chunks(vlads.catalog, vlads.store, Settings(), compact_chunks=2) == 1
    assert {photo_id: row.tolist() for photo_id, row in vlads.rows().items()} == {
        photo_id: row.tolist() for photo_id, row in before.items()
    }
    job = vlads.fit(seed=7)
    assert vlads.active().id != old.id
    assert set(vlads.rows()) == {*photo_ids, *more}
    assert (vlads.searchable(), job.progress_failed) == (4, 0)
    assert job.progress_done == job.progress_total


def test_a_vocabulary_is_fitted_on_database_photos_only(
    vlads: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo_ids = vlads.upload(*range(8))
    become(vlads, PhotoRole.QUERY, *photo_ids[::2])
    seen: list[str] = []
    real = fits.compute_fit

    def compute(request: VocabularyFitRequest, *arguments: Any) -> Any:
        seen.extend(request.photos)
        return real(request, *arguments)

    monkeypatch.setattr(fits, "compute_fit", compute)
    vlads.fit()
    with vlads.catalog.read() as session:
        keys = {session.get_one(Photo, photo_id).object_key for photo_id in photo_ids[1::2]}
    assert set(seen) == keys
    assert vlads.vocabulary(vlads.active().vocabulary_id).provenance["photos"] == 4
    assert set(vlads.rows()) == set(photo_ids)


@pytest.mark.usefixtures("fit_at_four_photos")
def test_waiting_queries_do_not_make_a_map_fit_a_vocabulary(vlads: Harness) -> None:
    """The fit would find nothing to learn from, and after a failure none begins by itself."""
    queries = vlads.upload(0, 1, 2)
    become(vlads, PhotoRole.QUERY, *queries)
    vlads.upload(3, 4, 5)
    vlads.drain()
    assert vlads.fit_if_due() == []
    vlads.upload(6)
    vlads.drain()
    assert len(vlads.fit_if_due()) == 1


def test_a_role_is_set_at_upload_and_changed_later(service: Service) -> None:
    stays, turns = service.indexed(1, 2, latitude=1, longitude=2)
    (asking,) = service.indexed(3, role="query", place="hall")
    photo = service.json("GET", f"/uploads/{asking}")
    assert (photo["role"], photo["searchable"]) == ("query", True)

    def found() -> set[str]:
        service.drain()
        answer = service.json("POST", f"/similarity/{asking}", params={"top_k": 100})
        assert answer["query_file_id"] == asking
        return {image["image_id"] for image in answer["similar_images"]}

    def counts() -> tuple[int, int, int]:
        stats = service.json("GET", "/database/stats")
        (listed,) = service.json("GET", "/maps")
        assert (stats["total_images"], stats["searchable_images"], stats["labelled_queries"]) == (
            listed["photos"],
            listed["searchable"],
            listed["labelled_queries"],
        )
        return stats["total_images"], stats["searchable_images"], stats["labelled_queries"]

    assert found() == {stays, turns}
    assert counts() == (2, 2, 1)
    service.json("PATCH", f"/uploads/{turns}", json={"role": "query"})
    assert found() == {stays}
    assert counts() == (1, 1, 2)
    response = service.ask(photo_bytes(2))
    service.drain()
    answer = service.json("GET", f"/jobs/{response}/result")
    assert [image["image_id"] for image in answer["similar_images"]] == [stays]
    service.json("PATCH", f"/uploads/{turns}", json={"role": None})  # null clears the field
    assert found() == {stays, turns}
    listed = service.json("GET", "/search", params={"role": "query"})
    assert [image["image_id"] for image in listed["images"]] == [asking]
    again = service("POST", "/upload", files={"file": photo_bytes(3)}, data={"role": "database"})
    assert (again.status_code, again.json()["code"]) == (409, "photo_differs")


def test_a_new_photo_is_compared_with_what_its_own_filter_lets_pass(service: Service) -> None:
    """The filter waits with the job, and is applied to the map as it is when the answer is read."""
    first, second = service.indexed(1, 2, captured_at="2024-05-06T07:08:09.123456+02:00")
    response = service.ask(
        near_copy(1),
        top_k=60,
        near="1,2,100",
        captured_after="2024-05-06T05:08:09.123456",
        tags="wet,night",
        ids=f"{first},{second}",
    )
    service.drain()

    def found() -> list[str]:
        answer = service.json("GET", f"/jobs/{response}/result")
        return [image["image_id"] for image in answer["similar_images"]]

    assert found() == []
    here = {"latitude": 1.0005, "longitude": 2, "tags": ["night", "x", "wet"]}
    service.json("PATCH", f"/uploads/{second}", json=here)
    assert found() == [second]
    service.json("PATCH", f"/uploads/{second}", json={"captured_at": "2024-05-06T05:08:09.123455"})
    assert found() == []


def test_an_empty_place_is_none(service: Service) -> None:
    """Photos of no label would all be of one place."""
    (photo,) = service.indexed(1, place="hall")
    for place, kept in ((" cellar ", "cellar"), ("   ", None)):
        assert service.json("PATCH", f"/uploads/{photo}", json={"place": place})["place"] == kept


def test_a_nul_is_refused_where_postgresql_could_not_keep_it(service: Service) -> None:
    for method, path, options in (
        ("GET", "/search", {"params": {"map": "a\0b"}}),
        ("GET", "/search", {"params": {"place": "a\0b"}}),
        ("GET", "/search", {"params": {"tags": "a\0b"}}),
        ("GET", "/maps/a%00b", {}),
        ("DELETE", "/maps/a%00b", {}),
        ("POST", "/maps", {"json": {"name": "x", "extractor": "a\0b"}}),
    ):
        answer = service(method, path, **options)
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid_field"), path
