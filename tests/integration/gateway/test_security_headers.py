"""What every answer says to browsers, and what none says to anybody."""

from __future__ import annotations

from typing import Any

import pytest
from starlette.testclient import TestClient

from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from services.search.worker import SearchWorker
from shared.catalog.database.session import Catalog
from shared.catalog.maps import get_or_create_default_map
from shared.config.settings import Settings
from shared.jobs import InProcessWakeups
from shared.storage import FolderStore
from tests.integration.api_with_keys import Door
from tests.support.problems import problem

HERE = "http://localhost"
MAPS = "https://maps.example"


class Broken:
    """A search tier with a bug."""

    def __getattr__(self, name: str) -> Any:
        raise RuntimeError(f"/srv/secret/place.py: {name}")


def client_of(catalog: Catalog, store: FolderStore, settings: Settings, search: Any) -> TestClient:
    with catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)
    keys = LocalhostAuthenticator(settings.allowed_origins)
    gateway = GatewayContext(catalog, store, InProcessWakeups(), search, settings, keys)
    return TestClient(create_app(gateway), base_url=HERE)


@pytest.fixture
def client(catalog: Catalog, store: FolderStore, settings: Settings) -> TestClient:
    return client_of(catalog, store, settings, SearchWorker(catalog, store, settings))


def checked(headers: Any) -> None:
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["x-frame-options"] == "DENY"
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["referrer-policy"]
    assert headers["cross-origin-opener-policy"] == "same-origin"


def test_every_answer_has_the_headers_and_one_of_the_api_is_kept_by_no_cache(
    client: TestClient,
) -> None:
    pages = ("/", "/docs", "/redoc", "/openapi.json", "/console/app.js", "/livez", "/api/v1/jobs")
    refused = {"/api/v1/nowhere": 404, "/api/v1/jobs?misspelt=1": 422}
    for path in (*pages, *refused):
        answer = client.get(path)
        assert answer.status_code == refused.get(path, 200), path
        checked(answer.headers)
        assert "strict-transport-security" not in answer.headers
    headers = client.get("/api/v1/jobs").headers
    assert headers["cache-control"] == "private, no-store"
    assert headers["content-security-policy"].startswith("default-src 'none'")


def test_responses_of_the_middleware_have_the_headers(door: Door) -> None:
    refused = door("wrong", "GET", "/jobs")
    problem(refused, 401, "key_unknown")
    checked(refused.headers)


def test_an_unhandled_error_returns_an_id_and_nothing_of_the_code(
    catalog: Catalog, store: FolderStore, settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    answer = client_of(catalog, store, settings, Broken()).get("/api/v1/health")
    body = problem(answer, 500, "internal_error")
    checked(answer.headers)
    assert not any(word in answer.text for word in ("secret", "place.py", "Runtime", "Traceback"))
    assert f"request {body['request_id']}" in caplog.text, "by which the log is searched"
    assert "/srv/secret/place.py" in caplog.text


def test_pages_of_other_origins_may_not_read_answers(client: TestClient) -> None:
    preflight = client.options(
        "/api/v1/jobs", headers={"Origin": MAPS, "Access-Control-Request-Method": "GET"}
    )
    assert not preflight.is_success
    for answer in (preflight, client.get("/livez", headers={"Origin": MAPS})):
        assert not [name for name in answer.headers if name.startswith("access-control")]
    problem(client.get("/api/v1/jobs", headers={"Origin": MAPS}), 403, "foreign_page")


def test_a_page_of_a_trusted_origin_may_call_and_read_answers(
    catalog: Catalog, store: FolderStore, settings: Settings
) -> None:
    open_to = settings.model_copy(update={"cors_origins": f"{MAPS}, https://other.example"})
    client = client_of(catalog, store, open_to, SearchWorker(catalog, store, settings))
    preflight = client.options(
        "/api/v1/jobs",
        headers={
            "Origin": MAPS,
            "Access-Control-Request-Method": "DELETE",
            "Access-Control-Request-Headers": "authorization, idempotency-key",
        },
    )
    assert preflight.status_code == 200
    assert preflight.headers["access-control-allow-origin"] == MAPS
    answer = client.get("/api/v1/jobs", headers={"Origin": MAPS})
    assert answer.status_code == 200
    assert answer.headers["access-control-allow-origin"] == MAPS
    assert "access-control-allow-credentials" not in answer.headers
    stranger = client.get("/api/v1/jobs", headers={"Origin": "https://evil.example"})
    problem(stranger, 403, "foreign_page")
    assert "access-control-allow-origin" not in stranger.headers
