"""HTTP transport of the client: authentication, timeouts, retries, pagination and streaming."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any, BinaryIO, Self, TypeVar

import httpx2

from placewise import answers
from placewise.protocol import (
    API,
    CHUNK_BYTES,
    IDEMPOTENCY_KEY,
    PATIENCE_SECONDS,
    TIMEOUT_SECONDS,
    Json,
    OnWait,
    RetryPolicy,
    drop_none,
    may_use_proxy,
    open_file,
    printable_name,
    response_error,
    to_text,
    validate_url,
)
from shared.errors import TooManyRequests, Unavailable
from shared.ids import new_id

PAGE_SIZE = 1000  # the server's maximum

Answer = TypeVar("Answer")
Record = TypeVar("Record", bound=answers.Answer)


class AsyncTransport:
    """Connections to one server and one map; close it, or use it as a context manager."""

    def __init__(
        self,
        url: str,
        *,
        key: str | None = None,
        map: str | None = None,  # noqa: A002
        patience_seconds: float = PATIENCE_SECONDS,
        timeout_seconds: float = TIMEOUT_SECONDS,
    ) -> None:
        """Create a client of a server and one of its maps. No request is sent yet.

        Calls are retried with exponential backoff while the server is unavailable (503, 507, no
        connection), and as its Retry-After says while it is busy (429). Every POST carries an
        Idempotency-Key, so that a retried call takes effect once. Files to upload are read in the
        thread of the caller, of an asynchronous client in that of the event loop.

        Args:
            url: URL of the server, such as `http://127.0.0.1:8000`.
            key: API key; a server on a loopback address may not require one.
            map: Name of the map; None for `default`.
            patience_seconds: How long calls are retried; 0 disables retries.
            timeout_seconds: Timeout of a single call, in seconds without a byte from the server.

        Raises:
            InvalidRequest: `bad_address`, `bad_key`.
        """
        self.url = validate_url(url, key)
        self._patience = RetryPolicy(patience_seconds)
        self._open(
            base_url=self.url,
            trust_env=may_use_proxy(self.url),
            timeout=timeout_seconds,
            params={"map": map} if map else None,
            headers={"Authorization": f"Bearer {key}"} if key else None,
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Close all connections."""
        await self._http.aclose()

    # All that waits is in `aclose` and the next four methods, which the blocking client overrides.

    def _open(self, **options: Any) -> None:
        self._http = httpx2.AsyncClient(**options)

    async def _sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def _send(self, method: str, url: str, **options: Any) -> httpx2.Response:
        return await self._http.request(method, url, **options)

    async def _receive(
        self, url: str, write: Callable[[bytes], object], **options: Any
    ) -> httpx2.Response:
        async with self._http.stream("GET", url, **options) as response:
            if response.is_success:
                async for chunk in response.aiter_bytes(CHUNK_BYTES):
                    write(chunk)
            else:
                await response.aread()
        return response

    def with_patience(self, patience_seconds: float, on_wait: OnWait) -> Self:
        """Return a client that shares the connections and retries calls for another period.

        Args:
            patience_seconds: How long calls are retried.
            on_wait: Called before each wait with the error and the number of seconds.
        """
        other = copy.copy(self)
        other._patience = RetryPolicy(patience_seconds, on_wait)
        return other

    async def _send_file(
        self,
        path: str,
        file: str | Path | BinaryIO | bytes,
        filename: str | None = None,
        fields: Json | None = None,
        **options: Any,
    ) -> Any:
        """POST a file, by its path or open, as the form field `file`, streamed."""
        with contextlib.ExitStack() as stack:
            if isinstance(file, (str, Path)):
                filename = filename or printable_name(Path(file))
                file = stack.enter_context(open_file(Path(file)))
            elif not isinstance(file, bytes) and not hasattr(file, "read"):
                raise TypeError(f"send a path, bytes or an open file, not {type(file).__name__}")
            files = {"file": (filename, file) if filename else file}  # or the open file's name
            data = {name: str(value) for name, value in to_text(**fields or {}).items()}
            return await self._call("POST", path, files=files, data=data, **options)

    async def _call(self, method: str, path: str, **options: Any) -> Any:
        """Send a request with retries and return the JSON of its response.

        `options` are those of the HTTP library, which rewinds `files` before each attempt. All
        attempts of a POST have the same Idempotency-Key.
        """
        if method == "POST" and self._patience.seconds:
            key = {IDEMPOTENCY_KEY: str(new_id())}
            options["headers"] = {**options.get("headers", {}), **key}

        async def attempt() -> Any:
            return (await self._check(self._send(method, f"{API}{path}", **options))).json()

        return await self._retry(attempt)

    async def _get_bytes(self, path: str) -> bytes:
        """GET a response that is not JSON."""

        async def attempt() -> bytes:
            return (await self._check(self._send("GET", f"{API}{path}"))).content

        return await self._retry(attempt)

    async def _iterate(
        self, model: type[Record], path: str, field: str, /, body: Json | None = None, **params: Any
    ) -> AsyncIterator[Record]:
        """Iterate over all records of a paginated list; pages are fetched on demand.

        Those that are computed from a `body` have the server's default size.
        """
        method, limit = ("GET", PAGE_SIZE) if body is None else ("POST", None)
        cursor: str | None = None
        while True:
            page_params = drop_none(**params, limit=limit, cursor=cursor)
            page = await self._call(method, path, params=page_params, json=body)
            for record in page[field]:
                yield model(**record)
            cursor = page["next_cursor"]
            if cursor is None:
                return

    async def _download(
        self, path: str, file: BinaryIO, on_received: Callable[[int], object]
    ) -> None:
        """Stream a response into a file, which is truncated before each attempt."""

        def write(chunk: bytes) -> None:
            file.write(chunk)
            on_received(file.tell())

        async def attempt() -> None:
            file.seek(0)
            file.truncate()
            await self._check(self._receive(f"{API}{path}", write))

        await self._retry(attempt)

    async def _check(self, sending: Awaitable[httpx2.Response]) -> httpx2.Response:
        """Await a response; an error response is raised as the matching PlacewiseError."""
        try:
            response = await sending
        except httpx2.TransportError as error:
            raise Unavailable(
                "server_unreachable",
                f"Can't reach Placewise at {self.url} ({str(error) or type(error).__name__}). "
                "Check the URL, and that it runs.",
            ) from error
        if response.is_success:
            return response
        raise response_error(response)

    async def _retry(self, call: Callable[[], Awaitable[Answer]]) -> Answer:
        deadline = time.monotonic() + self._patience.seconds
        attempt = 0
        while True:
            try:
                return await call()
            except (Unavailable, TooManyRequests) as error:
                is_late = time.monotonic() >= deadline
                await self._sleep(self._patience.wait_seconds(error, attempt, is_late))
                attempt += 1
