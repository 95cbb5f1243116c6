"""`HttpSearchClient` while its process stops, and where a worker refuses."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from shared.errors import Unavailable
from shared.ids import new_id
from shared.search_api.client import HttpSearchClient
from shared.search_api.protocol import SearchRequest, SearchResponse, SearchStatus

REQUEST = SearchRequest(
    generation_id=new_id(), object_key="queries/a.npy", row=0, min_version=0, k=1
)
RESPONSE = SearchResponse(
    hits=(), certificate="exhaustive", rows_scanned=0, rows_reranked=0, snapshot_version=1
)


class FakeWorker(ThreadingHTTPServer):
    """A search worker that answers, or refuses."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.status = SearchStatus(rows=0, resident_bytes=0, versions={}, missing=())
        self.refusal: Unavailable | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class _Handler(BaseHTTPRequestHandler):
    server: FakeWorker

    def do_GET(self) -> None:
        self._respond(self.server.status.model_dump_json())

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        refusal = self.server.refusal
        if refusal is None:
            self._respond(RESPONSE.model_dump_json())
        else:
            self._respond(json.dumps(refusal.as_problem()), refusal.status)

    def _respond(self, body: str, status: int = 200) -> None:
        self.send_response(status)
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
        server.shutdown()
        thread.join()


def test_a_search_that_begins_when_the_client_is_closed_is_unavailable(
    worker: FakeWorker,
) -> None:
    with HttpSearchClient([worker.url], 2.0) as client:
        assert client.search(REQUEST) == RESPONSE
    with pytest.raises(Unavailable) as refused:
        client.search(REQUEST)
    assert refused.value.code == "search_unavailable"


def test_engine_that_does_not_answer_is_reported_as_the_worker_does(worker: FakeWorker) -> None:
    worker.refusal = Unavailable("engine_unavailable", "Milvus does not answer.")
    with HttpSearchClient([worker.url], 2.0) as client, pytest.raises(Unavailable) as refused:
        client.search(REQUEST)
    assert refused.value.code == "engine_unavailable"
