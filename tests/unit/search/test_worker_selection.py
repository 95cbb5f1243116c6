"""Selection of search workers by their reported state and by their responses."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import httpx2
import pytest

from shared.errors import Gone, NotFound, Unavailable
from shared.ids import new_id
from shared.search_api.client import call_worker, fetch_status
from shared.search_api.protocol import SearchRequest, SearchResponse, SearchStatus
from shared.search_api.workers import WorkerDirectory, WorkerUnavailable

GENERATION = new_id()


class FakeWorkers:
    """`answers` says what each worker answers: a status, an HTTP answer, or an error to raise."""

    def __init__(self) -> None:
        self.answers: dict[str, SearchStatus | httpx2.Response | Exception] = {}
        self.http = httpx2.Client(transport=httpx2.MockTransport(self._answer))

    def _answer(self, request: httpx2.Request) -> httpx2.Response:
        found = self.answers[f"http://{request.url.host}"]
        if isinstance(found, Exception):
            raise found
        if isinstance(found, SearchStatus):
            return httpx2.Response(200, text=found.model_dump_json())
        return found

    def seen(self) -> WorkerDirectory:
        workers = WorkerDirectory(list(self.answers), partial(fetch_status, self.http))
        workers.refresh()
        return workers


@pytest.fixture
def fake() -> Iterator[FakeWorkers]:
    made = FakeWorkers()
    yield made
    made.http.close()


def holding(version: int | None = None, incomplete: bool = False) -> SearchStatus:
    return SearchStatus(
        rows=0,
        resident_bytes=0,
        versions={} if version is None else {GENERATION: version},
        incomplete=(GENERATION,) if incomplete else (),
        missing=(),
    )


REQUEST = SearchRequest(
    generation_id=GENERATION,
    object_key="queries/a.npy",
    row=0,
    min_version=0,
    k=1,
)


def test_current_workers_come_first_and_those_that_lack_chunks_after_them(
    fake: FakeWorkers,
) -> None:
    fake.answers = {
        "http://old": holding(version=4),
        "http://damaged": holding(version=5, incomplete=True),
        "http://new": holding(version=5),
        "http://away": httpx2.ConnectError("refused"),
    }
    workers = fake.seen()
    assert workers.urls(GENERATION, min_version=5) == [
        *("http://new", "http://damaged", "http://old", "http://away")
    ]
    best = workers.best_status()
    assert best is not None
    assert best.versions == {GENERATION: 5}


def test_a_worker_that_refuses_connections_is_tried_last_and_a_silent_one_never(
    fake: FakeWorkers,
) -> None:
    fake.answers = {name: holding(version=1) for name in ("http://a", "http://b")}
    workers = fake.seen()
    workers.mark_down("http://a")
    assert workers.urls(GENERATION) == ["http://b", "http://a"]
    fake.answers["http://a"] = httpx2.ConnectError("refused")
    fake.answers["http://b"] = httpx2.ReadTimeout("silent")
    workers.refresh()
    assert workers.urls(GENERATION) == ["http://a"]
    assert workers.best_status() is None
    fake.answers["http://b"] = holding(version=1)
    workers.refresh()
    assert workers.urls(GENERATION) == ["http://b", "http://a"]


@pytest.mark.parametrize(
    "answer",
    [
        httpx2.Response(502, text="<h1>Bad Gateway</h1>"),
        httpx2.Response(200, text="<h1>Welcome</h1>"),
        httpx2.Response(200, json={"hits": []}),
        httpx2.Response(500, json={"code": "internal_error", "detail": "Something went wrong."}),
        httpx2.ConnectTimeout("late"),
        httpx2.DecodingError("cut off"),
    ],
)
def test_a_server_that_does_not_answer_as_a_search_worker_is_unreachable(
    fake: FakeWorkers, answer: httpx2.Response | Exception
) -> None:
    fake.answers = {"http://a": answer}
    with pytest.raises(WorkerUnavailable, match="http://a"):
        call_worker(fake.http, "http://a/search", REQUEST, SearchResponse, 1.0)
    with pytest.raises(WorkerUnavailable):
        fetch_status(fake.http, "http://a")


@pytest.mark.parametrize("kind", [Gone, NotFound, Unavailable])
def test_what_a_worker_refuses_is_raised_as_the_error_that_it_was(
    fake: FakeWorkers, kind: type[Gone | NotFound | Unavailable]
) -> None:
    problem = kind("some_code", "Some detail.", object_key="a").as_problem()
    fake.answers = {"http://a": httpx2.Response(kind.status, json=problem)}
    with pytest.raises(kind) as caught:
        call_worker(fake.http, "http://a/search", REQUEST, SearchResponse, 1.0)
    assert (caught.value.code, caught.value.extra) == ("some_code", {"object_key": "a"})
