"""One call of the API after the other: keys, time limits, repetition.

`wire.py` is made of this file by `make client`: change this one.
"""

from __future__ import annotations

import asyncio
import copy
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self, TypeVar

import httpx2

from shared.client.sending import (
    API,
    CHUNK_BYTES,
    IDEMPOTENCY_KEY,
    TIMEOUT_SECONDS,
    Json,
    OnWait,
    RetryPolicy,
    Seekable,
    drop_none,
    open_file,
    printable_name,
    response_error,
    validate_url,
)
from shared.errors import Conflict, TooManyRequests, Unavailable
from shared.ids import new_id

PAGE_SIZE = 1000  # records asked for at once: the most that a server grants

Answer = TypeVar("Answer")


class AsyncTransport:
    """One server and one map; close it, or use it as a context manager."""

    def __init__(
        self,
        url: str,
        map_name: str | None = None,
        key: str | None = None,
        *,
        patience_seconds: float = 0.0,
        on_wait: OnWait = lambda error, seconds: None,
        timeout_seconds: float = TIMEOUT_SECONDS,
    ) -> None:
        """`key` is what a server beyond loopback wants; others don't look at it.

        A call is repeated for `patience_seconds` while the server is away or can't do it (503,
        507), after waits that double. One that says when to come again (429) is obeyed for as long
        as it says so: it works, and has too much to do. 0 repeats nothing. A single call takes
        `timeout_seconds` at most without a byte from the server.

        Raises InvalidRequest: `bad_key` for a key that no header can carry, `bad_address`.
        """
        self.url = validate_url(url, key)
        self._patience = RetryPolicy(patience_seconds, on_wait)
        self._timeout_seconds = timeout_seconds
        self._http = httpx2.AsyncClient(
            base_url=self.url,
            timeout=timeout_seconds,
            params={"map": map_name} if map_name else None,
            headers={"Authorization": f"Bearer {key}"} if key else None,
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        await self._http.aclose()

    def patient(self, patience_seconds: float, on_wait: OnWait) -> Self:
        """The same client with more patience, over the same connections."""
        other = copy.copy(self)
        other._patience = RetryPolicy(patience_seconds, on_wait)
        return other

    async def _send_file(
        self, path: str, file: Path, called: str | None = None, **options: Any
    ) -> Json:
        with open_file(file) as stream:
            files = {"file": (called or printable_name(file), stream)}
            return await self._call("POST", path, stream, files=files, **options)

    async def _call(
        self, method: str, path: str, body: Seekable | None = None, **options: Any
    ) -> Json:
        """One call of the API, repeated as patience allows; `body` is read from its begin."""
        if method == "POST" and self._patience.seconds:
            key = {IDEMPOTENCY_KEY: str(new_id())}
            options["headers"] = {**options.get("headers", {}), **key}

        async def once() -> Json:
            if body is not None:
                body.seek(0)
            answer = await self._ask(self._http, method, f"{API}{path}", **options)
            found: Json = answer.json()
            return found

        return await self._repeat(once)

    async def _get_bytes(self, path: str) -> bytes:
        async def once() -> bytes:
            return (await self._ask(self._http, "GET", f"{API}{path}")).content

        return await self._repeat(once)

    async def each(self, path: str, field: str, **params: Any) -> AsyncIterator[Json]:
        """Every record of a list that comes in pages, each fetched when it is reached."""
        cursor: str | None = None
        while True:
            asked = drop_none(**params, limit=PAGE_SIZE, cursor=cursor)
            page = await self._call("GET", path, params=asked)
            for one in page[field]:
                yield one
            cursor = page["next_cursor"]
            if cursor is None:
                return

    async def _fetch(self, path: str, file: BinaryIO, on_received: Callable[[int], object]) -> None:
        """Stream an answer into the file, which is emptied before each attempt."""

        async def once() -> None:
            file.seek(0)
            file.truncate()
            received = 0
            try:
                async with self._http.stream("GET", f"{API}{path}") as answer:
                    if not answer.is_success:
                        await answer.aread()
                        raise response_error(answer)
                    async for piece in answer.aiter_bytes(CHUNK_BYTES):
                        file.write(piece)
                        received += len(piece)
                        on_received(received)
            except httpx2.TransportError as error:
                raise self._unreachable("/", error) from error

        await self._repeat(once)

    async def _put(self, begun: Json, file: BinaryIO) -> None:
        """Send a direct upload's bytes to where the server has said: no key of ours goes there."""

        async def once() -> None:
            file.seek(0)
            async with httpx2.AsyncClient(timeout=self._timeout_seconds) as http:
                await self._ask(
                    http,
                    begun["method"],
                    begun["url"],
                    content=_iter_chunks(file),
                    headers=begun["headers"],
                )

        await self._repeat(once)

    async def _ask(
        self, http: httpx2.AsyncClient, method: str, url: str, **options: Any
    ) -> httpx2.Response:
        """A successful answer; anything else as the error that it means."""
        try:
            answer = await http.request(method, url, **options)
        except httpx2.TransportError as error:
            raise self._unreachable(url, error) from error
        if answer.is_success:
            return answer
        raise response_error(answer)

    def _unreachable(self, url: str, error: httpx2.TransportError) -> Unavailable:
        host = self.url if url.startswith("/") else httpx2.URL(url).host
        return Unavailable(
            "server_unreachable",
            f"No Placewise answers at {host} ({type(error).__name__}). Is it running?",
        )

    async def _repeat(self, call: Callable[[], Awaitable[Answer]]) -> Answer:
        deadline = time.monotonic() + self._patience.seconds
        times = 0
        while True:
            try:
                return await call()
            except (Unavailable, TooManyRequests, Conflict) as error:
                late = time.monotonic() >= deadline
                await asyncio.sleep(self._patience.wait_seconds(error, times, late))
                times += 1


async def _iter_chunks(file: BinaryIO) -> AsyncIterator[bytes]:
    while piece := file.read(CHUNK_BYTES):
        yield piece
