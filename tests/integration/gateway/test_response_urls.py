"""The URLs in the API's answers lead to what they promise, also in a map that is not `default`."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import httpx2

from tests.integration.in_process_api import API, Service
from tests.support.photos import encoded, photo_bytes, photo_image
from tools.make_api_page import openapi_description

# No URL depends on the database.
MAP = "words"
URLS = re.compile(r".+_url|image_path")


def urls_of(found: Any) -> Iterator[str]:
    """Every value of a field that is called a URL, however deep."""
    if isinstance(found, list):
        for one in found:
            yield from urls_of(one)
    if isinstance(found, dict):
        for name, value in found.items():
            if URLS.fullmatch(name) and value is not None:
                yield value
            yield from urls_of(value)


def operations_with_urls(openapi: dict[str, Any]) -> set[str]:
    """Ids of the calls whose successful answers have such fields."""
    schemas = openapi["components"]["schemas"]

    def has_url(described: Any) -> bool:
        referred = re.findall(r'"#/components/schemas/(\w+)"', json.dumps(described))
        return any(
            any(URLS.fullmatch(name) for name in schemas[one].get("properties", {}))
            or has_url(schemas[one])
            for one in referred
        )

    return {
        call["operationId"]
        for calls in openapi["paths"].values()
        for call in calls.values()
        if has_url([answer for status, answer in call["responses"].items() if status < "3"])
    }


COLMAP: dict[str, Any] = {
    "cameras": [{"model": "PINHOLE", "width": 64, "height": 48, "params": [50, 50, 32, 24]}],
    "photos": [
        {"name": f"{n}.jpg", "camera": 0, "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}
        for n in range(3)
    ],
}


class Followed:
    """Calls of the API on one map; every URL in an answer is followed as it stands."""

    def __init__(self, service: Service) -> None:
        self.service = service
        self.called: set[str] = set()

    def __call__(self, operation: str, method: str, path: str, **options: Any) -> Any:
        options["params"] = {"map": MAP, **options.get("params", {})}
        answer = self.service(method, path, **options)
        assert answer.is_success, f"{operation}: {answer.text}"
        self.called.add(operation)
        self._follow(operation, answer)
        return answer.json()

    def _follow(self, operation: str, answer: httpx2.Response) -> None:
        location = answer.headers.get("location")
        urls = [*urls_of(answer.json()), *([location] if location else [])]
        assert urls, operation
        for url in urls:
            found = self.service("GET", url.removeprefix(API))
            unfinished = url.startswith(f"{API}/jobs/") and "/result?" in url
            allowed = {200, 409} if unfinished else {200, 202} if "/frames/" in url else {200}
            assert found.status_code in allowed, f"{operation}: {url}: {found.text}"

    def cancel(self, started: dict[str, Any]) -> None:
        self("cancel_job", "POST", f"/jobs/{started['job_id']}/cancel")


def test_every_url_in_an_answer_leads_to_its_map(service: Service) -> None:
    service.json("POST", "/maps", 201, json={"name": MAP, "extractor": "test-tiny-vlad"})
    call = Followed(service)
    for number in range(1, 5):
        photo = {"file": ("photo.jpg", photo_bytes(number))}
        fields = {"place": f"room {number // 2}", "captured_at": f"2026-01-0{number}T12:00:00Z"}
        uploaded = call("upload", "POST", "/upload", files=photo, data=fields)
    fitted = call("fit_vocabulary", "POST", "/vocabularies", json={"clusters": 4})
    assert service.ended(fitted["job_id"], MAP)["state"] == "succeeded"
    file_id, job_id = uploaded["file_id"], uploaded["job_id"]

    call("list_jobs", "GET", "/jobs")
    call("get_job", "GET", f"/jobs/{job_id}")
    call("get_photo", "GET", f"/uploads/{file_id}")
    call("patch_photo", "PATCH", f"/uploads/{file_id}", json={"tags": ["a"]})
    call("search_metadata", "GET", "/search")
    call("restore_photo", "POST", f"/uploads/{file_id}/restore")
    call("patch_photo", "PATCH", f"/uploads/{file_id}", json={"place": None})
    call("propose_places", "POST", "/places/proposals", json={})

    call("similar_to_stored", "POST", f"/similarity/{file_id}")
    query = {"file": ("query.jpg", photo_bytes(5))}
    searched = call("similar_to_upload", "POST", "/similarity", files=query)
    assert service.ended(searched["job_id"], MAP)["state"] == "succeeded"
    call("similarity_result", "GET", f"/jobs/{searched['job_id']}/result")

    track = (
        f"/tracks/{service.json('POST', '/tracks', 201, params={'map': MAP}, json={})['track_id']}"
    )
    at = {"captured_at": "2026-01-05T12:00:00Z"}
    frame = call("add_track_frame", "POST", f"{track}/frames", files=query, data=at)
    service.drain()
    call("get_track_frame", "GET", f"{track}/frames/{frame['frame_id']}")
    call("get_track", "GET", track)

    wide = {"file": ("wide.jpg", encoded(photo_image(7, 1700, 64), "JPEG"))}
    waiting = call("upload", "POST", "/upload", files=wide)
    call("get_preview", "GET", f"/uploads/{waiting['file_id']}/preview")
    call.cancel(waiting)

    photo = {"file": ("photo.jpg", photo_bytes(6))}
    batch = call("upload_batch", "POST", "/upload/batch", files=photo)
    call.cancel(batch)
    waits = call("upload", "POST", "/upload", files=photo)
    refused = service("POST", f"/similarity/{waits['file_id']}", params={"map": MAP})
    assert service("GET", refused.json()["status_url"].removeprefix(API)).status_code == 200
    call.cancel(waits)
    call("retry_job", "POST", f"/jobs/{waits['job_id']}/retry")

    file = {"file": ("it.npy", b"is looked at by the extractor")}
    call.cancel(call("import_vocabulary", "POST", "/vocabularies/import", files=file))
    params = {"extractor": "test-tiny-avg"}
    call.cancel(call("start_generation", "POST", "/generations", json=params))
    call("add_model", "POST", "/models", files=file, data={"name": "one"})
    call("evaluate", "POST", "/evaluations")
    call.cancel(call("sync_library", "POST", "/library-syncs", json={}))
    call.cancel(call("reconstruct", "POST", "/reconstructions"))
    call.cancel(call("import_reconstruction", "POST", "/reconstructions/import", json=COLMAP))

    expected = operations_with_urls(openapi_description())
    assert call.called == expected, "a call that is not followed"
