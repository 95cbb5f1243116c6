"""A stand-in for an Immich server, made from the OpenAPI description of Immich 3.2.2.

It answers the calls that Placewise makes with the statuses, pages and errors of the description and
of the server's code, from assets in memory. It is not Immich.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from hashlib import sha1
from http.server import ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit
from uuid import UUID, uuid4

from tests.support.fake_server import QuietHandler, serving

KEY = "immich-key"
USER, PARTNER = str(uuid4()), str(uuid4())
NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)
ASSET_PATH = re.compile(r"/api/assets/([0-9a-f-]{36})(/thumbnail)?")
Json = dict[str, Any]
Answer = tuple[int, Any, dict[str, str]]


class ImmichServer(ThreadingHTTPServer):
    """One user's library. `before` is called with the method and path of each call."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.assets: dict[str, Json] = {}
        self.pictures: dict[str, bytes] = {}
        self.albums: dict[str, set[str]] = {}
        self.permissions = {"asset.read", "asset.view", "asset.update", "album.read", "user.read"}
        self.page_size = 1000
        self.busy: list[Answer] = []
        """answers of the next calls, instead of their own"""
        self.before: Callable[[str, str], object] = lambda method, path: None
        self.calls: Counter[str] = Counter()
        self.updates: list[Json] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def add(
        self,
        name: str,
        picture: bytes,
        position: tuple[float, float] | None = None,
        seconds: float = 0,
        album: str | None = None,
        **fields: Any,
    ) -> str:
        """Add an image that was taken so many seconds after noon UTC; returns its id."""
        asset_id = str(uuid4())
        taken = NOON + timedelta(seconds=seconds)
        latitude, longitude = position or (None, None)
        self.assets[asset_id] = {
            "id": asset_id, "ownerId": USER, "type": "IMAGE", "originalFileName": name,
            "checksum": sha1(picture, usedforsecurity=False).hexdigest(), "thumbhash": "1",
            "isTrashed": False, "isEdited": False, "visibility": "timeline",
            "fileCreatedAt": time_text(taken), "fileModifiedAt": time_text(taken),
            "updatedAt": time_text(datetime.now(UTC)),
            "localDateTime": time_text(taken + timedelta(hours=2)),
            "exifInfo": {
                "latitude": latitude, "longitude": longitude, "make": "Maker", "model": "X100",
                "dateTimeOriginal": time_text(taken), "timeZone": "UTC+2",
            },
            **fields,
        }  # fmt: skip
        self.pictures[asset_id] = picture
        if album:
            self.albums.setdefault(album, set()).add(asset_id)
        return asset_id

    def position(self, asset_id: str) -> tuple[float | None, float | None]:
        exif = self.assets[asset_id]["exifInfo"]
        return exif["latitude"], exif["longitude"]

    def move(self, asset_id: str, latitude: float | None, longitude: float | None) -> None:
        self.assets[asset_id]["exifInfo"].update(latitude=latitude, longitude=longitude)
        self.assets[asset_id]["updatedAt"] = time_text(datetime.now(UTC))

    def delete(self, asset_id: str) -> None:
        del self.assets[asset_id], self.pictures[asset_id]

    def answer(self, method: str, path: str, body: Json) -> Answer:
        if self.busy:
            return self.busy.pop(0)
        if path == "/api/server/version":
            return ok({"major": 3, "minor": 2, "patch": 2, "prerelease": None})
        if path == "/api/users/me":
            return self._with("user.read") or ok({"id": USER, "email": "user@example.com"})
        if path == "/api/albums":
            named = [{"id": name, "albumName": name} for name in self.albums]
            return self._with("album.read") or ok(named)
        if (method, path) == ("POST", "/api/search/metadata"):
            return self._with("asset.read") or self._search(body)
        if (method, path) == ("PUT", "/api/assets"):
            return self._with("asset.update") or self._update(body)
        if (method == "GET") and (match := ASSET_PATH.fullmatch(path)):
            asset_id, picture = match[1], bool(match[2])
            needed = "asset.view" if picture else "asset.read"
            if refusal := self._with(needed):
                return refusal
            if asset_id not in self.assets:
                return refused(400, f"Not found or no {needed} access")
            if not picture:
                return ok(self.assets[asset_id])
            data = self.pictures[asset_id]
            return (200, data, {}) if data else refused(404, "Asset media not found")
        return refused(404, f"Cannot {method} {path}")

    def _with(self, permission: str) -> Answer | None:
        if permission in self.permissions:
            return None
        return refused(403, f"Missing required permission: {permission}")

    def _search(self, body: Json) -> Answer:
        if not 1 <= body.get("size", 250) <= 1000:
            return refused(400, ["size must not be greater than 1000"])
        found = [
            asset
            for asset in self.assets.values()
            if asset["type"] == body.get("type", asset["type"])
            and not asset["isTrashed"]
            and all(asset["id"] in self.albums[each] for each in body.get("albumIds", []))
        ]
        found.sort(key=lambda asset: asset["fileCreatedAt"], reverse=True)
        size, page = min(self.page_size, body.get("size", 250)), body.get("page", 1)
        items = found[(page - 1) * size : page * size]
        more = str(page + 1) if page * size < len(found) else None
        if not body.get("withExif"):
            items = [{k: v for k, v in item.items() if k != "exifInfo"} for item in items]
        counts = {"total": len(items), "count": len(items), "facets": []}
        empty = {"total": 0, "count": 0, "facets": [], "items": []}
        return ok({"albums": empty, "assets": {**counts, "items": items, "nextPage": more}})

    def _update(self, body: Json) -> Answer:
        latitude, longitude = body.get("latitude"), body.get("longitude")
        for name, value, most in (("latitude", latitude, 90), ("longitude", longitude, 180)):
            if not isinstance(value, (int, float)) or abs(value) > most:
                return refused(400, [f"{name} must be a number"])  # null, too
        ids = [str(UUID(each)) for each in body["ids"]]
        if any(self.assets.get(each, {}).get("ownerId") != USER for each in ids):
            return refused(400, "Not found or no asset.update access")
        self.updates.append(body)
        for each in ids:
            self.move(each, latitude, longitude)
        return 204, b"", {}


class Handler(QuietHandler):
    server: ImmichServer

    def handle_call(self) -> None:
        path = urlsplit(self.path).path
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        self.server.calls[f"{self.command} {ASSET_PATH.sub('/api/assets/{id}', path)}"] += 1
        self.server.before(self.command, path)
        if self.headers.get("x-api-key") == KEY:
            status, answer, headers = self.server.answer(
                self.command, path, json.loads(body or b"{}")
            )
        else:
            status, answer, headers = refused(401, "Invalid API key")
        data = answer if isinstance(answer, bytes) else json.dumps(answer).encode()
        self.reply(status, data, headers)

    do_GET = do_POST = do_PUT = handle_call  # noqa: N815


def time_text(time: datetime) -> str:
    return f"{time:%Y-%m-%dT%H:%M:%S}.{time.microsecond // 1000:03d}Z"


def ok(body: Any) -> Answer:
    return 200, body, {}


def refused(status: int, message: Any, **headers: str) -> Answer:
    body = {"message": message, "error": "Refused", "statusCode": status, "correlationId": "c1"}
    return status, body, headers


@contextlib.contextmanager
def running_immich() -> Iterator[ImmichServer]:
    with ImmichServer() as made, serving(made):
        yield made
