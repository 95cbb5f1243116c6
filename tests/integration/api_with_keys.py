"""The HTTP API in this process, behind keys."""

from __future__ import annotations

from typing import Any

import httpx2
from fastapi import FastAPI
from starlette.testclient import TestClient

from services.gateway.app import create_app
from services.gateway.authentication import ApiKeyAuthenticator
from services.gateway.dependencies import GatewayContext
from services.search.worker import SearchWorker
from shared.catalog.database.session import Catalog
from shared.catalog.maps import get_or_create_default_map
from shared.config.settings import Settings
from shared.jobs import InProcessWakeups
from shared.security.api_keys import hash_api_key
from shared.storage import FolderStore
from tests.support.photos import photo_bytes
from tools.make_api_page import openapi_description

ADMIN = "the-key-of-the-admin-0123"


def make_app(gateway: GatewayContext) -> FastAPI:
    """The application, which is described already.

    Describing takes a second, and works out the routes, which all applications share. FastAPI
    otherwise does that at their first calls, which no two threads may make at once.
    """
    app = create_app(gateway)
    app.openapi_schema = openapi_description()
    return app


class Door:
    """The HTTP API behind keys."""

    def __init__(self, catalog: Catalog, store: FolderStore, settings: Settings) -> None:
        with catalog.write() as session:
            get_or_create_default_map(session, settings.extractor)
        search = SearchWorker(catalog, store, settings)
        keys = ApiKeyAuthenticator(catalog, hash_api_key(ADMIN))
        gateway = GatewayContext(catalog, store, InProcessWakeups(), search, settings, keys)
        self.catalog, self.store = catalog, store
        self.app = make_app(gateway)
        self._client = TestClient(self.app, base_url="http://places.example")

    def __call__(self, key: str, method: str, path: str, **options: Any) -> httpx2.Response:
        return self.call(key, method, f"/api/v1{path}", **options)

    def call(self, key: str, method: str, path: str, **options: Any) -> httpx2.Response:
        """A call to any path of the server."""
        headers = {"Authorization": f"Bearer {key}", **options.pop("headers", {})}
        return self._client.request(method, path, headers=headers, **options)

    def key(self, *scopes: str, **fields: Any) -> dict[str, Any]:
        """A new one, as it was answered."""
        params = {"name": "someone", "scopes": scopes, **fields}
        made = self(ADMIN, "POST", "/keys", json=params)
        assert made.status_code == 201, made.text
        answer: dict[str, Any] = made.json()
        return answer

    def put(self, key: str, number: int = 1) -> httpx2.Response:
        return self(key, "POST", "/upload", files={"file": ("photo.jpg", photo_bytes(number))})
