"""Thumbnails and previews: pictures without what a camera wrote beside them."""

from __future__ import annotations

import io
from uuid import UUID

from PIL import Image

from shared.storage.keys import preview_key
from tests.integration.in_process_api import Service
from tests.support.photos import encoded, photo_image


def test_a_large_photo_has_a_small_preview_from_its_description_to_its_deletion(
    service: Service,
) -> None:
    data = encoded(photo_image(7, 2400, 1200), "JPEG")
    file_id = service.upload(data)["file_id"]
    preview = service.json("GET", f"/uploads/{file_id}")["preview_url"]
    assert preview == f"/api/v1/uploads/{file_id}/preview"
    waiting = service("GET", f"/uploads/{file_id}/preview")
    assert waiting.status_code == 202
    assert waiting.json()["job_id"] == service.json("GET", f"/uploads/{file_id}")["job_id"]
    service.drain()
    answer = service("GET", f"/uploads/{file_id}/preview")
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/jpeg")
    with Image.open(io.BytesIO(answer.content)) as image:
        assert image.size == (1600, 800)
    same = {"If-None-Match": answer.headers["etag"]}
    assert service("GET", f"/uploads/{file_id}/preview", headers=same).status_code == 304
    service("DELETE", f"/uploads/{file_id}")
    assert service("GET", f"/uploads/{file_id}/preview").status_code == 404


def test_a_small_photo_is_its_own_preview(service: Service) -> None:
    data = encoded(photo_image(7, 640, 480), "JPEG")
    file_id = service.upload(data)["file_id"]
    assert service("GET", f"/uploads/{file_id}/preview").content == data
    service.drain()
    assert service("GET", f"/uploads/{file_id}/preview").content == data


def test_a_photo_of_an_earlier_release_gets_its_preview_on_the_first_request(
    service: Service,
) -> None:
    file_id = service.upload(encoded(photo_image(7, 2400, 1200), "JPEG"))["file_id"]
    service.drain()
    before = service.json("GET", f"/uploads/{file_id}")
    chunks = service.json("GET", "/database/stats")["total_chunks"]
    service.store.delete(preview_key(UUID(file_id)))
    first, second = (service("GET", f"/uploads/{file_id}/preview") for _ in range(2))
    assert first.status_code == second.status_code == 202
    assert first.json()["job_id"] == second.json()["job_id"] == before["job_id"]
    service.drain()
    assert service("GET", f"/uploads/{file_id}/preview").status_code == 200
    assert service.json("GET", f"/uploads/{file_id}") == before
    assert service.json("GET", "/database/stats")["total_chunks"] == chunks


def test_a_photo_that_can_not_be_decoded_has_no_preview_and_the_reason(service: Service) -> None:
    data = encoded(photo_image(7, 2400, 1200), "JPEG")
    file_id = service.upload(data[: len(data) // 2])["file_id"]
    service.drain()
    refused = service("GET", f"/uploads/{file_id}/preview")
    assert (refused.status_code, refused.json()["code"]) == (404, "preview_not_found")
    assert "can't be decoded" in refused.json()["detail"]


def test_a_query_photo_has_a_preview_if_not_all_browsers_show_its_format(service: Service) -> None:
    expected = {"TIFF": (200, (1600, 800)), "JPEG": (404, None)}
    for media, (status, size) in expected.items():
        data = encoded(photo_image(7, 2400, 1200), media)
        job_id = service.json("POST", "/similarity", 202, files={"file": ("query", data)})["job_id"]
        assert service("GET", f"/jobs/{job_id}/preview").status_code == 404, "not described yet"
        service.drain()
        answer = service("GET", f"/jobs/{job_id}/preview")
        assert answer.status_code == status, media
        if size is not None:
            with Image.open(io.BytesIO(answer.content)) as image:
                assert (image.format, image.size) == ("JPEG", size)
