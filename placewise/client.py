"""The client for code without asyncio: it runs the calls of AsyncClient without an event loop.

Its requests and waits block, so the coroutine of a call never suspends, and one step runs it to its
end, in the thread of the caller.
"""

from __future__ import annotations

import copy
import functools
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Any, Concatenate, ParamSpec, Self, TypeVar, cast

import httpx2

from placewise.async_client import AsyncClient, Work
from placewise.protocol import CHUNK_BYTES, PATIENCE_SECONDS, TIMEOUT_SECONDS, OnWait

__all__ = ["Client", "Work"]

P = ParamSpec("P")
Answer = TypeVar("Answer")


class _BlockingCalls(AsyncClient):
    """Calls whose coroutines never suspend."""

    def _open(self, **options: Any) -> None:
        self._blocking_http = httpx2.Client(**options)

    async def _sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    async def _send(self, method: str, url: str, **options: Any) -> httpx2.Response:
        return self._blocking_http.request(method, url, **options)

    async def _receive(
        self, url: str, write: Callable[[bytes], object], **options: Any
    ) -> httpx2.Response:
        with self._blocking_http.stream("GET", url, **options) as response:
            if response.is_success:
                for chunk in response.iter_bytes(CHUNK_BYTES):
                    write(chunk)
            else:
                response.read()
        return response

    async def aclose(self) -> None:
        self._blocking_http.close()


def _run(call: Awaitable[Answer]) -> Answer:
    try:
        next(call.__await__())
    except StopIteration as end:
        return cast("Answer", end.value)
    raise RuntimeError("a call of the blocking client has suspended")


def _iterate(items: AsyncIterator[Answer]) -> Iterator[Answer]:
    while True:
        try:
            item = _run(anext(items))
        except StopAsyncIteration:
            return
        yield item


def _blocking(
    method: Callable[Concatenate[AsyncClient, P], Awaitable[Answer]],
) -> Callable[Concatenate[Client, P], Answer]:
    @functools.wraps(method)
    def call(client: Client, /, *args: P.args, **kwargs: P.kwargs) -> Answer:
        return _run(method(client._calls, *args, **kwargs))

    return call


def _iterating(
    method: Callable[Concatenate[AsyncClient, P], AsyncIterator[Answer]],
) -> Callable[Concatenate[Client, P], Iterator[Answer]]:
    @functools.wraps(method)
    def call(client: Client, /, *args: P.args, **kwargs: P.kwargs) -> Iterator[Answer]:
        return _iterate(method(client._calls, *args, **kwargs))

    return call


class Client:
    """Client of one server and one map; close it, or use it as a context manager."""

    def __init__(
        self,
        url: str,
        *,
        key: str | None = None,
        map: str | None = None,  # noqa: A002
        patience_seconds: float = PATIENCE_SECONDS,
        timeout_seconds: float = TIMEOUT_SECONDS,
    ) -> None:
        """Create a client; the parameters are those of `AsyncClient`."""
        self._calls: AsyncClient = _BlockingCalls(
            url,
            key=key,
            map=map,
            patience_seconds=patience_seconds,
            timeout_seconds=timeout_seconds,
        )
        self.url = self._calls.url

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        _run(self._calls.aclose())

    def with_patience(self, patience_seconds: float, on_wait: OnWait) -> Self:
        """Return a client that shares the connections and retries calls for another period.

        Args:
            patience_seconds: How long calls are retried.
            on_wait: Called before each wait with the error and the number of seconds.
        """
        other = copy.copy(self)
        other._calls = self._calls.with_patience(patience_seconds, on_wait)
        return other

    upload = _blocking(AsyncClient.upload)
    upload_files = _blocking(AsyncClient.upload_files)
    import_objects = _blocking(AsyncClient.import_objects)
    sync_library = _blocking(AsyncClient.sync_library)
    import_prefix = _blocking(AsyncClient.import_prefix)
    batch_items = _iterating(AsyncClient.batch_items)
    similar = _blocking(AsyncClient.similar)
    read_header = _blocking(AsyncClient.read_header)
    propose_positions = _blocking(AsyncClient.propose_positions)
    begin_track = _blocking(AsyncClient.begin_track)
    add_frame = _blocking(AsyncClient.add_frame)
    track_frame = _blocking(AsyncClient.track_frame)
    track = _blocking(AsyncClient.track)
    tracks = _iterating(AsyncClient.tracks)
    delete_track = _blocking(AsyncClient.delete_track)
    job = _blocking(AsyncClient.job)
    jobs = _iterating(AsyncClient.jobs)
    watch = _iterating(AsyncClient.watch)
    wait = _blocking(AsyncClient.wait)
    cancel = _blocking(AsyncClient.cancel)
    retry = _blocking(AsyncClient.retry)
    photo = _blocking(AsyncClient.photo)
    image = _blocking(AsyncClient.image)
    photos = _iterating(AsyncClient.photos)
    patch_photo = _blocking(AsyncClient.patch_photo)
    delete_photo = _blocking(AsyncClient.delete_photo)
    restore_photo = _blocking(AsyncClient.restore_photo)
    propose_places = _iterating(AsyncClient.propose_places)
    give_places = _blocking(AsyncClient.give_places)
    undo_places = _blocking(AsyncClient.undo_places)
    fit_vocabulary = _blocking(AsyncClient.fit_vocabulary)
    import_vocabulary = _blocking(AsyncClient.import_vocabulary)
    vocabularies = _blocking(AsyncClient.vocabularies)
    vocabulary_file = _blocking(AsyncClient.vocabulary_file)
    start_generation = _blocking(AsyncClient.start_generation)
    generations = _blocking(AsyncClient.generations)
    export_descriptors = _blocking(AsyncClient.export_descriptors)
    reconstruct = _blocking(AsyncClient.reconstruct)
    import_reconstruction = _blocking(AsyncClient.import_reconstruction)
    reconstruction = _blocking(AsyncClient.reconstruction)
    coordinate_proposals = _blocking(AsyncClient.coordinate_proposals)
    export_colmap = _blocking(AsyncClient.export_colmap)
    evaluate = _blocking(AsyncClient.evaluate)
    evaluations = _iterating(AsyncClient.evaluations)
    searches = _iterating(AsyncClient.searches)
    maps = _blocking(AsyncClient.maps)
    create_map = _blocking(AsyncClient.create_map)
    update_map = _blocking(AsyncClient.update_map)
    delete_map = _blocking(AsyncClient.delete_map)
    stats = _blocking(AsyncClient.stats)
    add_model = _blocking(AsyncClient.add_model)
    models = _blocking(AsyncClient.models)
    remove_model = _blocking(AsyncClient.remove_model)
    keys = _blocking(AsyncClient.keys)
    create_key = _blocking(AsyncClient.create_key)
    revoke_key = _blocking(AsyncClient.revoke_key)
