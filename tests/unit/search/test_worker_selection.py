"""Selection of search workers by their reported state and by their responses."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import httpx2
import pytest

from shared.config.shards import Shard
from shared.errors import Gone, NotFound, Unavailable
from shared.ids import new_id
from shared.search_api.client import call_search, fetch_status
from shared.search_api.protocol import SearchRequest, SearchStatus
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


def holding(shard: str, version: int | None = None) -> SearchStatus:
    return SearchStatus(
        shard=shard,
        rows=0,
        resident_bytes=0,
        versions={} if version is None else {GENERATION: version},
        missing=(),
    )


REQUEST = SearchRequest(
    generation_id=GENERATION,
    object_key="queries/a.npy",
    row=0,
    min_version=0,
    k=1,
)


def test_replicas_of_a_shard_stand_together_and_the_current_one_comes_first(
    fake: FakeWorkers,
) -> None:
    fake.answers = {
        "http://old": holding("0/2", version=4),
        "http://new": holding("0/2", version=5),
        "http://other": holding("1/2", version=5),
    }
    layout = fake.seen().layout(GENERATION, min_version=5)
    assert layout == {Shard(0, 2): ["http://new", "http://old"], Shard(1, 2): ["http://other"]}


def test_a_shard_of_which_no_worker_was_ever_seen_is_known_by_the_others(
    fake: FakeWorkers,
) -> None:
    fake.answers = {
        "http://there": holding("0/3"),
        "http://away": httpx2.ConnectError("refused"),
    }
    workers = fake.seen()
    assert workers.layout(GENERATION, 0) == {
        Shard(0, 3): ["http://there"],
        Shard(1, 3): [],
        Shard(2, 3): [],
    }
    assert workers.statuses()[1] == [Shard(1, 3), Shard(2, 3)]


def test_a_worker_that_refuses_connections_is_tried_last_and_a_silent_one_never(
    fake: FakeWorkers,
) -> None:
    fake.answers = {name: holding("0/1", version=1) for name in ("http://a", "http://b")}
    workers = fake.seen()
    workers.mark_down("http://a")
    assert workers.layout(GENERATION, 0) == {Shard(0, 1): ["http://b", "http://a"]}
    fake.answers["http://a"] = httpx2.ConnectError("refused")
    fake.answers["http://b"] = httpx2.ReadTimeout("silent")
    workers.refresh()
    assert workers.layout(GENERATION, 0) == {Shard(0, 1): ["http://a"]}
    fake.answers["http://b"] = holding("0/1", version=1)
    workers.refresh()
    assert workers.layout(GENERATION, 0) == {Shard(0, 1): ["http://b", "http://a"]}


def test_a_new_number_of_shards_is_used_once_all_of_them_have_the_generation(
    fake: FakeWorkers,
) -> None:
    fake.answers = {"http://whole": holding("0/1", version=5), "http://half": holding("0/2")}
    assert list(fake.seen().layout(GENERATION, 5)) == [Shard(0, 1)]
    fake.answers["http://other"] = holding("1/2")
    assert list(fake.seen().layout(GENERATION, 5)) == [Shard(0, 1)], "nothing is loaded there yet"
    fake.answers["http://half"] = holding("0/2", version=5)
    assert list(fake.seen().layout(GENERATION, 5)) == [Shard(0, 1)], "one half is not enough"
    fake.answers["http://other"] = holding("1/2", version=5)
    assert list(fake.seen().layout(GENERATION, 5)) == [Shard(0, 2), Shard(1, 2)]


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
        call_search(fake.http, "http://a", REQUEST, 1.0)
    with pytest.raises(WorkerUnavailable):
        fetch_status(fake.http, "http://a")


@pytest.mark.parametrize("kind", [Gone, NotFound, Unavailable])
def test_what_a_worker_refuses_is_raised_as_the_error_that_it_was(
    fake: FakeWorkers, kind: type[Gone | NotFound | Unavailable]
) -> None:
    problem = kind("some_code", "Some detail.", object_key="a").as_problem()
    fake.answers = {"http://a": httpx2.Response(kind.status, json=problem)}
    with pytest.raises(kind) as caught:
        call_search(fake.http, "http://a", REQUEST, 1.0)
    assert (caught.value.code, caught.value.extra) == ("some_code", {"object_key": "a"})
