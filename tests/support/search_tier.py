"""Real search servers in threads, with the client in front of them."""

from __future__ import annotations

import contextlib
import threading
from typing import Any, Self

import uvicorn

from services.http_connections import ConnectionLimits, Connections
from services.http_server import http_server, listen, reachable_url
from services.search.service import create_search_app
from services.search.worker import MAX_WAIT_SECONDS, SearchWorker
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.search_api.client import SEARCH_TIMEOUT_SECONDS, HttpSearchClient
from shared.storage import ObjectStore
from tests.support.waiting import wait_until

START_SECONDS = 20.0


class SearchServer:
    """One worker behind HTTP; it may be stopped and started again on its port.

    It follows the catalog only when a test asks its `worker` to.
    """

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        settings: Settings,
        max_wait_seconds: float,
    ) -> None:
        self._of = (catalog, store, settings)
        self._max_wait_seconds = max_wait_seconds
        self._port = 0
        self._running: tuple[uvicorn.Server, threading.Thread, contextlib.ExitStack] | None = None
        self.url = ""
        self.start()

    def start(self) -> None:
        """A new worker, which has to load everything anew."""
        self.worker = SearchWorker(*self._of, max_wait_seconds=self._max_wait_seconds)
        held = contextlib.ExitStack()
        listener = held.enter_context(listen("127.0.0.1", self._port))
        self._port = listener.getsockname()[1]
        self.url = reachable_url("127.0.0.1", self._port)
        limits = ConnectionLimits.of(self._of[2])
        server = http_server(create_search_app(self.worker), Connections(limits))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        self._running = server, thread, held

    def wait_until_started(self) -> None:
        assert self._running is not None
        server = self._running[0]
        wait_until(lambda: server.started, START_SECONDS)

    def ask_to_stop(self) -> None:
        if self._running is not None:
            self._running[0].should_exit = True

    def stop(self) -> None:
        """Calls are refused from now on."""
        if self._running is not None:
            self.ask_to_stop()
            _, thread, held = self._running
            thread.join()
            held.close()
            self._running = None


class SearchTier:
    """`servers`, and `port`, the client of them all."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        settings: Settings,
        replicas: int = 1,
        max_wait_seconds: float = MAX_WAIT_SECONDS,
        timeout_seconds: float = SEARCH_TIMEOUT_SECONDS,
    ) -> None:
        self.servers = [
            SearchServer(catalog, store, settings, max_wait_seconds) for _ in range(replicas)
        ]
        for server in self.servers:
            server.wait_until_started()
        self.port = HttpSearchClient([server.url for server in self.servers], timeout_seconds)

    def __enter__(self) -> Self:
        self.port.__enter__()
        return self

    def __exit__(self, *raised: Any) -> None:
        self.port.__exit__(*raised)
        for server in self.servers:
            server.ask_to_stop()
        for server in self.servers:
            server.stop()

    def follow(self) -> None:
        """Every worker brings itself up to date."""
        for server in self.servers:
            server.worker.sync()
