"""The page as the gateway sends it: types, caching, and that nothing is from elsewhere."""

from __future__ import annotations

import re
from pathlib import Path

import httpx2
import pytest
from fastapi import FastAPI
from pydantic import ValidationError
from starlette.testclient import TestClient

from services.gateway.web_page import add_web_page
from services.web import HTML_FOLDER, PAGE_FOLDER
from shared.config.settings import Settings
from shared.http.problem_details import install_exception_handlers

TILES = "https://tiles.example.org/{z}/{x}/{y}.png"
HTML = {"Accept": "text/html,*/*"}
SOURCES = sorted([*HTML_FOLDER.rglob("*"), *PAGE_FOLDER.rglob("*")])


def served(settings: Settings) -> TestClient:
    app = FastAPI(docs_url=None, redoc_url=None)
    install_exception_handlers(app)
    add_web_page(app, settings)
    return TestClient(app, base_url="http://localhost")


@pytest.fixture
def page(settings: Settings) -> TestClient:
    return served(settings)


def policy(answer: httpx2.Response) -> dict[str, str]:
    parts = answer.headers["content-security-policy"].split("; ")
    return {name: value for name, _, value in (part.partition(" ") for part in parts)}


def test_the_root_answers_browsers_with_html_and_programs_with_json(page: TestClient) -> None:
    shown = page.get("/", headers=HTML)
    assert shown.headers["content-type"] == "text/html; charset=utf-8"
    assert "<title>Placewise</title>" in shown.text
    reported = page.get("/", headers={"Accept": "*/*"})
    assert reported.json()["service"] == "Placewise"
    for answer in (shown, reported):
        assert "Accept" in answer.headers["vary"]


@pytest.mark.parametrize(
    ("path", "media_type"),
    [
        ("app.js", "text/javascript; charset=utf-8"),
        ("views/ask.js", "text/javascript; charset=utf-8"),
        ("style.css", "text/css; charset=utf-8"),
        ("mark.svg", "image/svg+xml"),
    ],
)
def test_static_files_have_a_content_type_and_are_compressed(
    page: TestClient, path: str, media_type: str
) -> None:
    zipped = page.get(f"/console/{path}", headers={"Accept-Encoding": "gzip"})
    plain = page.get(f"/console/{path}", headers={"Accept-Encoding": "identity"})
    assert zipped.headers["content-type"] == plain.headers["content-type"] == media_type
    assert ("content-encoding" in zipped.headers) == (len(plain.content) >= 500)
    assert "content-encoding" not in plain.headers
    assert zipped.content == plain.content


def test_an_unchanged_file_is_answered_with_304(page: TestClient) -> None:
    first = page.get("/console/app.js")
    again = page.get("/console/app.js", headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["etag"] == first.headers["etag"]
    other = page.get("/console/app.js", headers={"If-None-Match": '"another"'})
    assert other.status_code == 200


@pytest.mark.parametrize("path", ["nothing.js", "../app.py", "%2e%2e/__init__.py", "index.html"])
def test_paths_outside_the_page_are_not_served(page: TestClient, path: str) -> None:
    answer = page.get(f"/console/{path}")
    assert answer.status_code == 404
    assert answer.json()["code"] == "path_not_found"


def test_the_content_security_policy_allows_only_map_tiles_of_another_server(
    page: TestClient,
) -> None:
    allowed = policy(page.get("/", headers=HTML))
    assert allowed["default-src"] == "'self'"
    assert allowed["img-src"] == "'self' blob: data: https://tile.openstreetmap.org"
    assert not any("unsafe" in value for value in allowed.values())
    for path in ("/docs", "/redoc"):
        assert "script-src" not in policy(page.get(path)), "scripts are this server's alone"


def test_the_content_security_policy_without_map_tiles_allows_no_other_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MAP_TILES", "off")
    page = served(Settings())
    assert policy(page.get("/", headers=HTML))["img-src"] == "'self' blob: data:"
    body = page.get("/console/settings.json").json()
    assert (body["map_tiles"], body["map_attribution"]) == (None, None)


def test_the_page_has_its_url_as_a_qr_code(page: TestClient) -> None:
    answer = page.get("/console/qr.svg", params={"url": "http://192.168.1.23:8000"})
    assert answer.headers["content-type"] == "image/svg+xml"
    assert answer.text.startswith("<?xml")
    for refused in ("javascript:alert(1)", "http://a b", "https://" + "x" * 200):
        assert page.get("/console/qr.svg", params={"url": refused}).status_code == 422


def test_the_content_security_policy_names_the_tile_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAP_TILES", TILES)
    monkeypatch.setenv("MAP_ATTRIBUTION", "© somebody")
    page = served(Settings())
    allowed = policy(page.get("/", headers=HTML))
    assert allowed["img-src"] == "'self' blob: data: https://tiles.example.org"
    body = page.get("/console/settings.json").json()
    assert (body["map_tiles"], body["map_attribution"]) == (TILES, "© somebody")


def test_tiles_need_an_attribution_and_an_address_of_a_server_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MAP_TILES", TILES)
    with pytest.raises(ValidationError, match="MAP_ATTRIBUTION"):
        Settings()
    monkeypatch.setenv("MAP_ATTRIBUTION", "© somebody")
    for tiles in (
        "tiles.example.org/{z}/{x}/{y}.png",
        "https://tiles.example.org/",
        "https://tiles.example.org; script-src */{z}/{x}/{y}.png",
        "javascript:alert({z}{x}{y})",
    ):
        monkeypatch.setenv("MAP_TILES", tiles)
        with pytest.raises(ValidationError, match="is not a URL template"):
            Settings()


@pytest.mark.parametrize("path", [path for path in SOURCES if path.suffix == ".html"])
def test_pages_have_no_inline_script_or_style(path: Path) -> None:
    text = path.read_text()
    assert not re.search(r"<style|\sstyle=|\son\w+=", text)
    assert all(tag.endswith("></script>") for tag in re.findall(r"<script.*?</script>", text))


@pytest.mark.parametrize("path", [path for path in SOURCES if path.is_file()])
def test_no_file_of_the_page_loads_from_another_server(path: Path) -> None:
    addresses = re.findall(r"https?://[^\s\"'`)?]+", path.read_text())
    # A link, which is opened only by a click, and names of XML's namespaces.
    assert set(addresses) <= {
        "https://www.openstreetmap.org/",
        "http://www.topografix.com/GPX/1/1",
        "http://www.w3.org/2000/svg",
    }


def test_every_module_that_is_imported_is_there(page: TestClient) -> None:
    expected = set()
    for path in PAGE_FOLDER.rglob("*.js"):
        for name in re.findall(r"(?:from|import)\s*\(?\"(\.[^\"]+)\"", path.read_text()):
            expected.add((path.parent / name).resolve().relative_to(PAGE_FOLDER).as_posix())
    assert expected
    for name in sorted(expected):
        assert page.get(f"/console/{name}").status_code == 200, name
