"""A real browser on a real server, in which lies a small generated city."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright

from tests.browser.city import build_city, finished
from tests.support.server import ServerProcess

CHROMIUM = "PLACEWISE_TEST_CHROMIUM"
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PICTURES = "PLACEWISE_PICTURES"
PATIENCE_MS = 120_000  # a busy machine makes seconds of work take minutes

expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture(scope="session")
def chromium() -> str:
    """The browser's program; fails, and says how to get it, where there is none."""
    named = os.environ.get(CHROMIUM)
    found = named or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.fail(
            "There is no Chromium here. Install it (apt-get install chromium), or name the program "
            f"of one in {CHROMIUM}."
        )
    return found


@pytest.fixture(scope="session")
def browser(chromium: str) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        # In containers the tests are root's, and Chromium's sandbox refuses root.
        options = ["--no-sandbox"] if os.geteuid() == 0 else []
        opened = playwright.chromium.launch(executable_path=chromium, args=options)
        yield opened
        opened.close()


@pytest.fixture(scope="session")
def city(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CityServer]:
    """A server with the default extractor and a described, measured city in the map `riverside`."""
    folder = tmp_path_factory.mktemp("city")
    with ServerProcess(folder / "home", extractor="efficientnet-lite0-vlad") as server:
        queries = build_city(server, folder / "city", MAP)
        yield CityServer(server, queries)


MAP = "riverside"


@dataclass(frozen=True, slots=True)
class CityServer:
    server: ServerProcess
    queries: list[Path]
    """Photos that the map has never seen."""

    @property
    def url(self) -> str:
        return str(self.server.client.base_url).rstrip("/")

    def get(self, path: str, **params: Any) -> Any:
        answer = self.server.client.get(f"/api/v1{path}", params={"map": MAP, **params})
        assert answer.is_success, answer.text
        return answer.json()

    def ask(self, photo: Path) -> Any:
        """What the API answers to the photo."""
        answer = self.server.client.post(
            "/api/v1/similarity",
            params={"map": MAP, "top_k": 12},
            files={"file": (photo.name, photo.read_bytes())},
            headers={"Prefer": "wait=60"},
        )
        assert answer.status_code == 200, answer.text
        return answer.json()

    def ride(self) -> str:
        """A track past the first photos of the map, one every ten seconds."""
        images = self.get("/search", role="database", limit=3)["images"]
        begun = self.server.client.post(
            "/api/v1/tracks", params={"map": MAP}, json={"motion": "train"}
        )
        assert begun.status_code == 201, begun.text
        path = f"/api/v1/tracks/{begun.json()['track_id']}"
        for number, image in enumerate(images):
            photo = self.server.client.get(image["image_url"]).content
            answer = self.server.client.post(
                f"{path}/frames",
                params={"map": MAP},
                files={"file": (f"frame-{number}.jpg", photo)},
                data={"captured_at": f"2026-05-01T12:00:{number}0Z"},
                headers={"Prefer": "wait=60"},
            )
            assert answer.status_code == 200, answer.text
        return str(begun.json()["track_id"])

    def work(self, path: str, **params: Any) -> None:
        """Start the map's job and see it through."""
        started = self.server.client.post(f"/api/v1{path}", params={"map": MAP}, json=params)
        assert started.status_code == 202, started.text
        finished(self.server, MAP, started.json()["job_id"])


class Visitor:
    """One window, its errors (`faults`) and its requests to other servers (`foreign`)."""

    def __init__(self, context: BrowserContext, url: str) -> None:
        self.url = url
        self.page: Page = context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.faults: list[str] = []
        self.foreign: list[str] = []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("console", self._on_console)
        self.page.on("request", self._on_request)

    def expect_no_error(self) -> None:
        """Check that the page shows no error."""
        expect(self.page.locator(".note.bad")).to_have_count(0)

    def _on_console(self, message: Any) -> None:
        # A refusal of the server is shown on the page; the browser writes it down as well.
        if message.type in ("error", "warning") and "Failed to load resource" not in message.text:
            self.faults.append(message.text)

    def _on_request(self, request: Any) -> None:
        parts = urlsplit(request.url)
        if parts.scheme in ("http", "https") and parts.netloc != urlsplit(self.url).netloc:
            self.foreign.append(request.url)

    def visit(self, view: str) -> Page:
        """Open the view anew: `ask`, `photos`, `photo/ID`, `tracks`, `tracks/ID`, `add`, ..."""
        self.page.goto("about:blank")
        self.page.goto(f"{self.url}/#/{view}")
        expect(self.page.locator("h1")).to_be_visible()
        return self.page


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    opened = browser.new_context(viewport={"width": 1280, "height": 860}, reduced_motion="reduce")
    opened.add_init_script(
        "if (location.protocol === 'http:' && !localStorage.getItem('placewise-map'))"
        f" localStorage.setItem('placewise-map', '{MAP}')"
    )
    yield opened
    opened.close()


@pytest.fixture
def visitor(context: BrowserContext, city: CityServer) -> Iterator[Visitor]:
    """A window on the city; it must have no errors and send nothing to other servers."""
    visiting = Visitor(context, city.url)
    yield visiting
    assert visiting.faults == []
    assert visiting.foreign == []


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where screenshots go: the folder that PLACEWISE_PICTURES names, or one that is forgotten."""
    named = os.environ.get(PICTURES)
    folder = Path(named) if named else tmp_path_factory.mktemp("pictures")
    folder.mkdir(parents=True, exist_ok=True)
    return folder
