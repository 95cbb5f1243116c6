"""Fault injection: a TCP proxy that simulates network and disk faults, and duplicated messages."""

from __future__ import annotations

import asyncio
import contextlib
import enum
import re
import threading
from collections.abc import AsyncIterator, Iterator
from typing import Self

from redis import Redis
from redis.exceptions import RedisError

from shared.jobs.wakeups import WakeupQueue

CHUNK_BYTES = 65_536
CUT_AFTER_BYTES = 700  # inside the body of a photo or chunk, after the request's headers
SLOW_DELAY_SECONDS = 0.05  # per chunk of data
SLOW_CHUNK_BYTES = 2_048
DISK_FULL_RESPONSE = (
    b"HTTP/1.1 507 Insufficient Storage\r\nContent-Type: application/xml\r\n"
    b"Content-Length: 0\r\nConnection: close\r\n\r\n"
)
WRITE_METHODS = (b"PUT ", b"POST ")


class ProxyMode(enum.Enum):
    """Behaviour of connections. Changing it closes the open ones."""

    OPEN = "everything passes"
    REFUSED = "every connection ends at once"
    CUT = "every connection ends within its first request"
    CUT_ANSWER = "every connection ends after so many bytes of answers"
    SLOW = "every connection crawls"
    FULL = "HTTP: what would write is answered with 507, the rest passes"


CUT_MODES = {ProxyMode.CUT, ProxyMode.CUT_ANSWER}


class FaultProxy:
    """TCP proxy from `port` to 127.0.0.1:`target`, with the behaviour of `mode`."""

    def __init__(self, port: int, target: int) -> None:
        self.port = port
        self._target = target
        self._mode = ProxyMode.OPEN
        self._cut_after_bytes = CUT_AFTER_BYTES
        self._open: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
        self._server: asyncio.Server | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        started = asyncio.run_coroutine_threadsafe(
            asyncio.start_server(self._accepted, "127.0.0.1", self.port), self._loop
        )
        self._server = started.result()
        return self

    def __exit__(self, *_: object) -> None:
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    @contextlib.contextmanager
    def in_mode(self, mode: ProxyMode, *, cut_after_bytes: int = CUT_AFTER_BYTES) -> Iterator[None]:
        """Context manager that sets the mode."""
        self._cut_after_bytes = cut_after_bytes
        self.set_mode(mode)
        try:
            yield
        finally:
            self.set_mode(ProxyMode.OPEN)

    def set_mode(self, mode: ProxyMode) -> None:
        """Set the mode, which closes the open connections."""

        async def change() -> None:
            self._mode = mode
            await self._drop_all()

        asyncio.run_coroutine_threadsafe(change(), self._loop).result()

    async def _drop_all(self) -> None:
        standing = list(self._open)
        for one in standing:
            one.cancel()
        await asyncio.gather(*standing, return_exceptions=True)

    async def _close(self) -> None:
        assert self._server is not None
        self._server.close()
        await self._drop_all()
        await self._server.wait_closed()

    async def _accepted(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._open.add(task)
        try:
            with contextlib.suppress(OSError, asyncio.IncompleteReadError):
                await self._serve(reader, writer)
        except asyncio.CancelledError:
            pass  # the mode changed
        finally:
            self._open.discard(task)
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        mode = self._mode
        if mode is ProxyMode.REFUSED:
            return
        head = b""
        if mode is ProxyMode.FULL:
            head = await reader.readuntil(b"\r\n\r\n")
            if head.startswith(WRITE_METHODS):
                await self._refuse_as_full(head, reader, writer)
                return
            # One request on this connection: the next one may be a write.
            head = (
                re.sub(rb"(?i)\r\nconnection:[^\r]*", b"", head)[:-2] + b"Connection: close\r\n\r\n"
            )
        async with self._upstream() as (up_reader, up_writer):
            up_writer.write(head)
            both = [
                asyncio.create_task(self._pump(reader, up_writer, mode, cut=mode is ProxyMode.CUT)),
                asyncio.create_task(self._pump(up_reader, writer, mode, cut=mode in CUT_MODES)),
            ]
            try:
                await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
                # What the other side had sent already still arrives.
                await asyncio.wait(both, timeout=0 if mode in CUT_MODES else 1)
            finally:
                for pump in both:
                    pump.cancel()
                await asyncio.gather(*both, return_exceptions=True)

    @contextlib.asynccontextmanager
    async def _upstream(self) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
        reader, writer = await asyncio.open_connection("127.0.0.1", self._target)
        try:
            yield reader, writer
        finally:
            writer.transport.abort()

    async def _refuse_as_full(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        length = re.search(rb"(?i)\r\ncontent-length: *(\d+)", head)
        await reader.readexactly(int(length[1]) if length else 0)
        writer.write(DISK_FULL_RESPONSE)
        await writer.drain()
        writer.write_eof()
        await reader.read()  # until the client has had it all

    async def _pump(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        mode: ProxyMode,
        *,
        cut: bool,
    ) -> None:
        passed, most = 0, self._cut_after_bytes
        while piece := await reader.read(
            SLOW_CHUNK_BYTES if mode is ProxyMode.SLOW else CHUNK_BYTES
        ):
            if cut and passed + len(piece) > most:
                writer.write(piece[: most - passed])
                await writer.drain()
                return
            if mode is ProxyMode.SLOW:
                await asyncio.sleep(SLOW_DELAY_SECONDS)
            writer.write(piece)
            await writer.drain()
            passed += len(piece)
        writer.write_eof()


class MessageDuplicator:
    """Watches Redis and pushes each message of a lane once more. `doubled` counts them."""

    def __init__(self, url: str) -> None:
        self._url = url
        self.duplicated_messages = 0

    @contextlib.contextmanager
    def duplicating(self) -> Iterator[None]:
        with (
            Redis.from_url(self._url) as watching,
            Redis.from_url(self._url) as pushing,
            watching.monitor() as monitor,
        ):
            own_port = pushing.client_info()["addr"].rpartition(":")[2]
            stop = threading.Event()
            watcher = threading.Thread(
                target=self._watch, args=(monitor, pushing, own_port, stop), daemon=True
            )
            watcher.start()
            try:
                yield
            finally:
                stop.set()
                pushing.ping()  # the next thing that the watcher sees
                watcher.join(timeout=5)

    def _watch(self, monitor, pushing: Redis, own_port: str, stop: threading.Event) -> None:  # type: ignore[no-untyped-def]
        with contextlib.suppress(RedisError, ValueError):
            for seen in monitor.listen():
                if stop.is_set():
                    return
                words = seen["command"].split(" ", 2)
                is_own = seen["client_port"] == own_port
                if is_own or words[0] != "LPUSH" or words[1] not in set(WakeupQueue):
                    continue
                # A waiting message as it lies there: MONITOR's own text is quoted.
                message = pushing.lindex(words[1], 0)
                if message is not None:
                    pushing.lpush(words[1], message)
                    self.duplicated_messages += 1
