"""The calls of Immich's HTTP API that Placewise needs.

Own code instead of a library: `immich-python-sdk` describes Immich 1.134, and the eight calls that
are needed have been the same from 1.135 to 3.2.2 (the OpenAPI descriptions of `@immich/sdk`).
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Sequence
from typing import Any

import httpx2

from placewise.protocol import Json, RetryPolicy, may_use_proxy, response_error, validate_url
from shared.errors import NotFound, PlacewiseError, TooManyRequests, Unavailable, Unprocessable

TIMEOUT_SECONDS = 60.0
RETRY_PERIOD_SECONDS = 60.0
PAGE_SIZE = 1000  # the most that Immich returns
WRITE_INTERVAL_SECONDS = 0.1
"""Between two writes: each makes Immich write a sidecar and look up the name of the place"""
HINTS = {401: " Check IMMICH_API_KEY.", 403: " Add it to the API key."}
Coordinates = tuple[float, float]


class ImmichApi:
    """Calls one Immich server as one user; busy or unavailable, it is called again for a minute.

    Every call raises the PlacewiseError of the status that Immich answers: `immich_refused`.
    """

    def __init__(self, url: str, key: str) -> None:
        self.url = validate_url(url, key).removesuffix("/api")
        self._http = httpx2.Client(
            base_url=f"{self.url}/api",
            trust_env=may_use_proxy(self.url),
            headers={"x-api-key": key},
            timeout=TIMEOUT_SECONDS,
        )
        self._retries = RetryPolicy(RETRY_PERIOD_SECONDS)
        self._next_write = 0.0

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def version(self) -> str:
        """Return the version of the server, such as `2.7.5`."""
        answer = self._json("GET", "/server/version")
        return ".".join(str(answer[part]) for part in ("major", "minor", "patch"))

    def user_id(self) -> str:
        """Return the id of the user that the key belongs to."""
        return str(self._json("GET", "/users/me")["id"])

    def albums(self) -> list[Json]:
        """Return the albums, with `id` and `albumName`."""
        answer: list[Json] = self._json("GET", "/albums")
        return answer

    def images(self, **conditions: Any) -> Iterator[Json]:
        """Iterate over the images that are not in the trash, with their EXIF.

        An image may be missing, or come twice, if others are added or deleted meanwhile.
        """
        page: str | None = "1"
        while page is not None:
            body = {"type": "IMAGE", "withExif": True, "size": PAGE_SIZE, "page": int(page)}
            found = self._json("POST", "/search/metadata", json=body | conditions)["assets"]
            yield from found["items"]
            page = found["nextPage"]

    def asset(self, asset_id: str) -> Json | None:
        """Return an asset with its EXIF; None if it does not exist any more."""
        try:
            answer: Json = self._json("GET", f"/assets/{asset_id}")
        except NotFound:
            return None
        return answer

    def preview(self, asset_id: str) -> bytes:
        """Return the preview of an image, a JPEG or WebP of about 1440 pixels."""
        path = f"/assets/{asset_id}/thumbnail"
        return self._call("GET", path, params={"size": "preview"}).content

    def set_coordinates(self, asset_ids: Sequence[str], coordinates: Coordinates) -> None:
        """Give assets coordinates in degrees. Immich's API can't take coordinates away."""
        time.sleep(max(0.0, self._next_write - time.monotonic()))
        self._next_write = time.monotonic() + WRITE_INTERVAL_SECONDS
        latitude, longitude = coordinates
        body = {"ids": list(asset_ids), "latitude": latitude, "longitude": longitude}
        self._call("PUT", "/assets", json=body)

    def _json(self, method: str, path: str, **options: Any) -> Any:
        response = self._call(method, path, **options)
        try:
            return response.json()
        except ValueError as error:
            raise Unprocessable(
                "immich_refused", f"{response.url} is not JSON. Is it the address of Immich?"
            ) from error

    def _call(self, method: str, path: str, **options: Any) -> httpx2.Response:
        deadline, attempt = time.monotonic() + RETRY_PERIOD_SECONDS, 0
        while True:
            try:
                return self._attempt(method, path, options)
            except (Unavailable, TooManyRequests) as error:
                is_late = time.monotonic() >= deadline
                time.sleep(self._retries.wait_seconds(error, attempt, is_late))
                attempt += 1

    def _attempt(self, method: str, path: str, options: Json) -> httpx2.Response:
        try:
            response = self._http.request(method, path, **options)
        except httpx2.TransportError as error:
            raise Unavailable(
                "immich_refused", f"Immich at {self.url} does not answer: {error}"
            ) from error
        if not response.is_success:
            raise _error_of(response)
        return response


def _error_of(response: httpx2.Response) -> PlacewiseError:
    """Convert an error of Immich, which is JSON with `message`, or of a proxy before it."""
    status, text = response.status_code, response.text[:200]
    with contextlib.suppress(ValueError, KeyError, TypeError):
        message = json.loads(response.text)["message"]
        text = "; ".join(message) if isinstance(message, list) else str(message)
    detail = f"Immich answers {status} to {response.request.method} {response.url.path}: {text}"
    if status == 400 and text.startswith("Not found or no "):
        status = 404
    problem = {"code": "immich_refused", "detail": f"{detail}.{HINTS.get(status, '')}"}
    headers = {"retry-after": response.headers.get("retry-after", "")}
    status = 503 if status in (502, 504) else status
    return response_error(httpx2.Response(status, headers=headers, json=problem))
