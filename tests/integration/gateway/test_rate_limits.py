"""How much a key may do: counted across gateways, returned in headers, rejected beyond."""

from __future__ import annotations

import logging
import time
from collections import Counter
from functools import partial
from threading import Barrier, Event
from types import SimpleNamespace
from typing import Any

import httpx2
import pytest
from pydantic import SecretStr
from sqlalchemy import func, select

from services.gateway import rate_limits
from services.gateway.routes import uploads as uploads_module
from services.steward.batches.worker import BatchWorker
from shared.catalog.database.session import Catalog
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.ingest import store_photo, validation
from shared.ingest.validation import ValidatedPhoto
from shared.jobs import InProcessWakeups
from shared.storage import FolderStore
from tests.integration.api_with_keys import ADMIN, Door
from tests.support.photos import photo_bytes
from tests.support.problems import problem
from tests.support.servers import RedisServer, start_redis
from tests.support.threads import at_once


@pytest.fixture(autouse=True)
def _one_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """No minute ends between two calls, in which a counter of this process begins a new window."""
    stopped = SimpleNamespace(time=lambda now=time.time(): now)
    monkeypatch.setattr("limits.storage.memory.time", stopped)
    monkeypatch.setattr("limits.strategies.time", stopped)


@pytest.fixture(params=["in this process", "redis"])
def settings_of_counts(
    request: pytest.FixtureRequest, settings: Settings, redis: RedisServer
) -> Settings:
    """The counters: of one process, or shared by several."""
    if request.param == "redis":
        return settings.model_copy(update={"redis_url": SecretStr(redis.url)})
    return settings


@pytest.fixture
def limited(catalog: Catalog, store: FolderStore, settings_of_counts: Settings) -> Door:
    return Door(catalog, store, settings_of_counts)


def test_calls_beyond_the_limit_are_refused_and_every_answer_says_how_far_it_is(
    limited: Door,
) -> None:
    key = limited.key("read", requests_per_minute=3)["key"]
    left = []
    for _ in range(3):
        answer = limited(key, "GET", "/jobs")
        assert answer.status_code == 200
        assert answer.headers["ratelimit-policy"] == '"requests";q=3;w=60'
        left.append(answer.headers["ratelimit"].split(";")[1])
    assert left == ["r=2", "r=1", "r=0"]
    refused = limited(key, "GET", "/jobs")
    body = problem(refused, 429, "too_many_requests")
    assert body["limit"] == 3
    assert 1 <= int(refused.headers["retry-after"]) <= 60
    other = limited.key("read", requests_per_minute=3)["key"]
    assert limited(other, "GET", "/jobs").status_code == 200, "each key has its own"
    assert "ratelimit" not in limited(ADMIN, "GET", "/jobs").headers


def test_settings_limit_keys_that_have_no_limit_of_their_own(
    catalog: Catalog, store: FolderStore, settings: Settings
) -> None:
    strict = settings.model_copy(update={"key_requests_per_minute": 1})
    door = Door(catalog, store, strict)
    key, larger = door.key("read")["key"], door.key("read", requests_per_minute=9)["key"]
    assert [door(key, "GET", "/jobs").status_code for _ in range(2)] == [200, 429]
    assert [door(larger, "GET", "/jobs").status_code for _ in range(2)] == [200, 200]
    assert [door(ADMIN, "GET", "/jobs").status_code for _ in range(2)] == [200, 200]


def test_gateways_that_share_a_redis_share_their_counts(
    catalog: Catalog, store: FolderStore, settings: Settings, redis: RedisServer
) -> None:
    shared = settings.model_copy(update={"redis_url": SecretStr(redis.url)})
    one, other = Door(catalog, store, shared), Door(catalog, store, shared)
    key = one.key("read", requests_per_minute=2)["key"]
    answers = [door(key, "GET", "/jobs").status_code for door in (one, other, one, other)]
    assert answers == [200, 200, 429, 429]


def test_without_its_redis_a_gateway_answers_all_calls_and_says_so_once(
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rate_limits, "REDIS_RETRY_SECONDS", 0.0)
    with start_redis(own=True) as redis, caplog.at_level(logging.WARNING):
        door = Door(catalog, store, settings.model_copy(update={"redis_url": SecretStr(redis.url)}))
        key = door.key("read", requests_per_minute=1)["key"]
        assert [door(key, "GET", "/jobs").status_code for _ in range(2)] == [200, 429]
        assert redis.process is not None
        redis.process.kill()
        assert [door(key, "GET", "/jobs").status_code for _ in range(3)] == [200] * 3
        assert [record.message.count("Redis is unreachable") for record in caplog.records] == [1]
        redis.process.start()
        assert [door(key, "GET", "/jobs").status_code for _ in range(2)] == [200, 429]
        assert "rate limits are on" in caplog.text


def test_the_photo_quota_of_a_key_counts_live_photos(
    door: Door, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store_photo, "FULL_RECOUNT_SECONDS", 0.0)
    key = door.key("write", max_photos=2)["key"]
    for _ in range(3):  # the same bytes again, and none at all, are no further photos
        assert door.put(key, 1).status_code in (200, 202)
        assert door(key, "POST", "/upload", files={"file": b""}).status_code == 400
    stored = [door.put(key, number).json()["file_id"] for number in (1, 2)]
    problem(door.put(key, 3), 429, "photo_quota_reached")
    assert door.put(ADMIN, 4).status_code == 202
    assert door(key, "DELETE", f"/uploads/{stored[0]}").status_code == 200
    assert door.put(key, 3).status_code == 202


def test_tracks_and_their_frames_count_in_the_limits_of_their_key(
    door: Door, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store_photo, "FULL_RECOUNT_SECONDS", 0.0)

    def send(key: str, track_id: str, number: int) -> httpx2.Response:
        data = {"captured_at": f"2026-05-01T12:00:0{number}Z"}
        files = {"file": ("frame.jpg", photo_bytes(number))}
        return door(key, "POST", f"/tracks/{track_id}/frames", data=data, files=files)

    key = door.key("read", max_photos=3)["key"]
    begun = door(key, "POST", "/tracks", json={})
    track_id = begun.json()["track_id"]
    assert [send(key, track_id, number).status_code for number in (1, 2)] == [202, 202]
    problem(send(key, track_id, 3), 429, "photo_quota_reached")
    problem(door(key, "POST", "/tracks", json={}), 429, "photo_quota_reached")
    assert send(ADMIN, track_id, 4).status_code == 202, "each frame counts for its own key"
    assert door(ADMIN, "DELETE", f"/tracks/{track_id}").status_code == 200
    assert door(key, "POST", "/tracks", json={}).status_code == 201

    calls = door.key("read", requests_per_minute=1)["key"]
    assert [door(calls, "POST", "/tracks", json={}).status_code for _ in "ab"] == [201, 429]


def test_parallel_uploads_store_exactly_as_many_photos_as_the_key_may(
    door: Door, monkeypatch: pytest.MonkeyPatch
) -> None:
    most, uploads = 3, 8
    all_received = Barrier(uploads)
    real = validation.validate_photo

    def examine_together(*arguments: Any) -> ValidatedPhoto:
        all_received.wait(60)
        return real(*arguments)

    monkeypatch.setattr(uploads_module, "validate_photo", examine_together)
    key = door.key("write", max_photos=most)["key"]
    answers = at_once(*(partial(door.put, key, number) for number in range(uploads)))
    codes = Counter(answer.status_code for answer in answers)
    assert codes == {202: most, 429: uploads - most}
    with door.catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(Photo)) == most
    refused = next(answer for answer in answers if answer.status_code == 429)
    problem(refused, 429, "photo_quota_reached")
    assert len(list(door.store.list("originals/"))) == most, "what is refused leaves no bytes"


def test_photos_of_a_batch_count_too(
    door: Door, catalog: Catalog, store: FolderStore, settings: Settings
) -> None:
    key = door.key("write", max_photos=2)["key"]
    sent = [("file", (f"{number}.jpg", photo_bytes(number))) for number in range(4)]
    started = door(key, "POST", "/upload/batch", files=sent)
    assert started.status_code == 202, started.text
    BatchWorker(catalog, store, InProcessWakeups(), settings, "steward").run_next(Event())
    items = door(ADMIN, "GET", f"/jobs/{started.json()['job_id']}/items").json()["items"]
    assert [item["state"] for item in items] == ["running", "running", "failed", "failed"]
    assert items[2]["error"]["code"] == "photo_quota_reached"
