"""Deleted photos: in the trash for a time, restored, or deleted for good."""

from __future__ import annotations

from uuid import UUID

import pytest
from sqlalchemy import delete, update

from services.steward.tasks.compaction import merge_small_chunks
from services.steward.tasks.garbage_collection import collect_deleted_photos
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.chunks import Descriptor
from shared.catalog.database.base import db_now
from shared.catalog.generations import active_generation
from shared.catalog.maps import get_map
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.storage.keys import ORIGINALS, thumbnail_key
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import merge_all
from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import problem

pytestmark = pytest.mark.databases("sqlite")


def originals(service: Service) -> int:
    return sum(1 for _ in service.store.list(ORIGINALS))


def found(service: Service, number: int) -> list[str]:
    """The photos that a query finds."""
    job_id = service.ask(near_copy(number))
    service.drain()
    service.search.sync()
    answer = service.json("GET", f"/jobs/{job_id}/result")
    return [photo["image_id"] for photo in answer["similar_images"]]


def removed(service: Service) -> list[str]:
    images = service.json("GET", "/search", params={"removed": True})["images"]
    return [photo["image_id"] for photo in images]


def test_a_deleted_photo_is_restored_and_found_again(service: Service) -> None:
    photo, other = service.indexed(1, 2, latitude=45.0, longitude=7.0)
    service.json("DELETE", f"/uploads/{photo}")
    collect_deleted_photos(service.catalog, service.store, 3600.0)
    assert (found(service, 1), removed(service)) == ([other], [photo])
    assert service("GET", f"/uploads/{photo}").status_code == 404
    assert service("GET", f"/uploads/{photo}/thumbnail").status_code == 200

    restored = service.json("POST", f"/uploads/{photo}/restore")
    assert restored["latitude"] == 45.0
    service.drain()
    assert found(service, 1) == [photo, other]
    assert removed(service) == []
    again = service.json("POST", f"/uploads/{photo}/restore")
    assert again["image_id"] == photo


def test_a_merge_of_chunks_keeps_the_rows_of_removed_photos(service: Service) -> None:
    photo, other = service.indexed(1, 2)
    service.json("DELETE", f"/uploads/{photo}")
    with service.catalog.read() as session:
        generation = active_generation(session, get_map(session, "default").id)
    assert generation
    assert merge_all(service.catalog, service.store, generation.id)
    assert found(service, 1) == [other]
    service.json("POST", f"/uploads/{photo}/restore")
    assert service.json("GET", f"/uploads/{photo}")["searchable"]
    assert found(service, 1) == [photo, other]
    assert merge_small_chunks(service.catalog, service.store, Settings()) == 0


def test_a_restored_photo_that_lost_its_descriptor_is_described_again(service: Service) -> None:
    photo, other = service.indexed(1, 2)
    service.json("DELETE", f"/uploads/{photo}")
    with service.catalog.write() as session:  # as a model change leaves it out
        session.execute(delete(Descriptor).where(Descriptor.photo_id == UUID(photo)))
    service.json("POST", f"/uploads/{photo}/restore")
    service.drain()
    assert found(service, 1) == [photo, other]


def test_bytes_are_deleted_when_the_time_in_the_trash_is_over(service: Service) -> None:
    photo, _ = service.indexed(1, 2)
    service.json("DELETE", f"/uploads/{photo}")
    collect_deleted_photos(service.catalog, service.store, 3600.0)
    collect_orphans(service.catalog, service.store, 0.0)
    assert originals(service) == 2
    assert service.store.head(thumbnail_key(UUID(photo)))
    with service.catalog.write() as session:
        session.execute(update(Photo).where(Photo.purge_at.is_not(None)).values(purge_at=db_now()))
    collect_deleted_photos(service.catalog, service.store, 3600.0)
    assert originals(service) == 1
    assert removed(service) == []
    assert problem(service("POST", f"/uploads/{photo}/restore"), 404, "photo_not_found")


def test_a_photo_is_deleted_for_good_at_once_or_from_the_trash(service: Service) -> None:
    photos = service.indexed(1, 2, 3)
    service.json("DELETE", f"/uploads/{photos[0]}", params={"permanently": True})
    service.json("DELETE", f"/uploads/{photos[1]}")
    service.json("DELETE", f"/uploads/{photos[1]}", params={"permanently": True})
    collect_deleted_photos(service.catalog, service.store, 3600.0)
    assert originals(service) == 1
    again = service("DELETE", f"/uploads/{photos[1]}", params={"permanently": True})
    assert problem(again, 404, "photo_not_found")


def test_a_photo_that_was_added_again_is_not_restored_beside_it(service: Service) -> None:
    (photo,) = service.indexed(1)
    service.json("DELETE", f"/uploads/{photo}")
    (second,) = service.indexed(1)
    refused = problem(service("POST", f"/uploads/{photo}/restore"), 409, "photo_exists")
    assert refused["file_id"] == second
    assert photo_bytes(1) == service("GET", f"/uploads/{second}/image").content
