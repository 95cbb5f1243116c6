"""The card of the photo library that a map follows."""

from __future__ import annotations

from pathlib import Path

from playwright.sync_api import Browser, expect

from tests.support.immich_server import KEY, running_immich
from tests.support.photos import photo_bytes
from tests.support.server import ServerProcess


def test_the_status_shows_what_the_map_has_of_the_library_and_why_it_has_not(
    browser: Browser, tmp_path: Path
) -> None:
    with running_immich() as immich:
        for number in range(3):
            immich.add(f"{number}.jpg", photo_bytes(number), (number + 1.0, 7.0))
        broken = immich.add("broken.jpg", b"", (9.0, 7.0))
        immich.add("unlocated.jpg", photo_bytes(9))
        settings = {"immich_url": immich.url, "immich_api_key": KEY}
        with ServerProcess(tmp_path / "home", **settings) as server:
            page = browser.new_page()
            page.goto(f"{server.client.base_url}#/status")
            heading = page.get_by_role("heading", name="Photo library")
            card = page.locator("section.card").filter(has=heading)
            expect(page.get_by_role("heading", name="Status")).to_be_visible()
            expect(card).to_be_hidden()
            body = {"every_hours": 24}
            job = server.client.post("/api/v1/library-syncs", json=body).json()["job_id"]
            assert server.finished(job)["state"] == "succeeded"
            expect(card).to_contain_text("3 indexed, 0 changed, 0 removed")
            expect(card).to_contain_text("every 24 hours")
            card.get_by_text("1 photo failed").click()
            expect(card).to_contain_text("broken.jpg: Immich answers 404")
            immich.delete(broken)
            immich.permissions.clear()
            card.get_by_role("button", name="Update now").click()
            expect(card).to_contain_text("Missing required permission: user.read")
            expect(card).to_contain_text("every 24 hours")
            page.close()
