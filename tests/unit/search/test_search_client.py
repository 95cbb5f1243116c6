"""`HttpSearchClient` while its process stops."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from shared.errors import Unavailable
from shared.ids import new_id
from shared.search_api.client import HttpSearchClient
from shared.search_api.protocol import SearchRequest, SearchResponse, SearchStatus
from tests.support.servers.handle import wait_until

REQUEST = SearchRequest(
    generation_id=new_id(), object_key="queries/a.npy", row=0, min_version=0, k=1
)
RESPONSE = SearchResponse(
    hits=(), certificate="exhaustive", rows_scanned=0, rows_reranked=0, snapshot_version=1
)


class FakeWorker(ThreadingHTTPServer):
    """A search worker of one shard that records the requests and answers when `released`."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.status = SearchStatus(rows=0, resident_bytes=0, versions={}, missing=())
        self.received: list[dict[str, object]] = []
        self.released = threading.Event()
        self.released.set()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class _Handler(BaseHTTPRequestHandler):
    server: FakeWorker

    def do_GET(self) -> None:
        self._respond(self.server.status.model_dump_json())

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.received.append(json.loads(body))
        self.server.released.wait(30)
        self._respond(RESPONSE.model_dump_json())

    def _respond(self, body: str) -> None:
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body.encode())

    def log_message(self, *_: object) -> None:
        """Write nothing to stderr."""


@pytest.fixture
def worker() -> Iterator[FakeWorker]:
    with FakeWorker() as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.released.set()
        server.shutdown()
        thread.join()


def test_a_search_that_is_queued_or_begins_when_the_client_is_closed_is_unavailable(
    worker: FakeWorker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shared.search_api.client.MAX_CONCURRENT_CALLS", 1)
    worker.released.clear()
    with ThreadPoolExecutor(3) as pool:
        client = HttpSearchClient([worker.url], 2.0)
        with client:
            first = pool.submit(client.search, REQUEST)
            wait_until(lambda: len(worker.received) == 1, 30, lambda: None, "the first call")
            queued = pool.submit(client.search, REQUEST)
            queue = client._call_executor._work_queue
            wait_until(lambda: queue.qsize() == 1, 30, lambda: None, "the queued call")
            threading.Timer(0.2, worker.released.set).start()
        assert first.result() == RESPONSE
        searches: list[Callable[[], SearchResponse]] = [
            queued.result,
            lambda: client.search(REQUEST),
        ]
        for search in searches:
            with pytest.raises(Unavailable) as refused:
                search()
            assert refused.value.code == "search_unavailable"
