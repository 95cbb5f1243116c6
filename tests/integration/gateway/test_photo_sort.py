"""Photos in the order in which they were taken."""

from __future__ import annotations

import pytest

from tests.integration.in_process_api import Service
from tests.support.photos import photo_bytes


@pytest.mark.databases("sqlite", "postgresql")
def test_dated_photos_are_listed_by_when_they_were_taken_in_pages(service: Service) -> None:
    times = ["2025-06-18T10:00:00Z", None, "2025-06-20T10:00:00Z", "2025-06-18T10:00:00Z"]
    ids = [
        service.upload(photo_bytes(number), **({"captured_at": time} if time else {}))["file_id"]
        for number, time in enumerate(times)
    ]
    seen: list[str] = []
    cursor = None
    while True:
        params = {"sort": "taken", "limit": 1, **({"cursor": cursor} if cursor else {})}
        page = service.json("GET", "/search", params=params)
        assert page["total_found"] == 3
        seen += [photo["image_id"] for photo in page["images"]]
        if not (cursor := page["next_cursor"]):
            break
    assert seen == [ids[2], ids[3], ids[0]]
