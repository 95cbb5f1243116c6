"""Search over several machines: failures, lag, placement, and status."""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Callable
from typing import Any

import httpx2
import pytest
from starlette.testclient import TestClient

from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from services.search import service
from services.steward.map_evaluation import MapEvaluation
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.maps import Matching
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.errors import Unavailable
from shared.evaluation.places.levels import LevelScheme
from shared.jobs import InProcessWakeups
from shared.search_api.protocol import SearchRequest, SearchResponse
from shared.storage import FolderStore
from tests.support.search_tier import SearchServer, SearchTier
from tests.support.small_map import SmallMap, assert_answers, unit_rows
from tests.support.waiting import wait_until

pytestmark = pytest.mark.databases("postgresql")

BACK_SECONDS = 20.0  # for a worker that was started again to be seen: about one, in truth
VECTOR = unit_rows(1000, 1)[0]


@pytest.fixture
def places(catalog: Catalog, store: FolderStore) -> SmallMap:
    made = SmallMap(catalog, store)
    for seed in range(3):
        made.add(unit_rows(seed, 3))
    return made


OpenTier = Callable[..., SearchTier]


@pytest.fixture
def tier_of(catalog: Catalog, store: FolderStore, settings: Settings) -> Any:
    """Opens tiers with so many workers; each has loaded everything."""
    opened: list[SearchTier] = []

    def open_tier(replicas: int, **changes: float) -> SearchTier:
        tier = SearchTier(catalog, store, settings, replicas, max_wait_seconds=0.2, **changes)
        tier.follow()
        opened.append(tier.__enter__())
        return tier

    yield open_tier
    for tier in opened:
        tier.__exit__(None, None, None)


def ask(tier: SearchTier, places: SmallMap, k: int = 100, **changes: Any) -> SearchResponse:
    request = places.request(places.query(VECTOR), k=k)
    return tier.port.search(request.model_copy(update=changes))


# --- who dies --------------------------------------------------------------------------------


def test_searches_continue_when_a_replica_is_killed_and_it_serves_again_when_it_is_back(
    places: SmallMap, tier_of: OpenTier
) -> None:
    tier = tier_of(2)
    everything = places.brute_force(VECTOR, 100)
    tier.servers[0].stop()
    for _ in range(8):  # whichever replica is first
        assert_answers(ask(tier, places), everything)
    tier.servers[0].start()
    tier.servers[1].stop()

    def is_back() -> bool:
        with contextlib.suppress(Unavailable):
            assert_answers(ask(tier, places), everything)
            return True
        return False

    wait_until(is_back, BACK_SECONDS)


# --- who lags --------------------------------------------------------------------------------


def refusing(
    server: SearchServer, monkeypatch: pytest.MonkeyPatch, code: str = "search_behind"
) -> list[SearchRequest]:
    """Let the worker refuse every search; the requests that it gets."""
    requests: list[SearchRequest] = []

    def search(request: SearchRequest) -> SearchResponse:
        requests.append(request)
        raise Unavailable(code, "Not now.")

    monkeypatch.setattr(server.worker, "search", search)
    return requests


def test_the_current_replica_answers_while_the_other_is_behind(
    places: SmallMap, tier_of: OpenTier, monkeypatch: pytest.MonkeyPatch
) -> None:
    tier = tier_of(2)
    searched = refusing(tier.servers[0], monkeypatch)
    for _ in range(10):
        response = ask(tier, places)
        assert response.missing == ()
        assert_answers(response, places.brute_force(VECTOR, 100))
    assert searched, "the replica that is behind was never tried first"


def test_workers_that_all_stay_behind_are_retried_until_the_deadline(
    places: SmallMap, tier_of: OpenTier, monkeypatch: pytest.MonkeyPatch
) -> None:
    tier = tier_of(1, timeout_seconds=2.0)
    searched = refusing(tier.servers[0], monkeypatch)
    started = time.monotonic()
    with pytest.raises(Unavailable) as caught:
        ask(tier, places)
    assert caught.value.code == "search_behind"
    assert len(searched) > 2, "it was not retried"
    assert time.monotonic() - started < 60, "2 s, on a busy machine"


def test_another_worker_answers_for_one_that_hangs(
    places: SmallMap, tier_of: OpenTier, monkeypatch: pytest.MonkeyPatch
) -> None:
    tier = tier_of(2, timeout_seconds=4.0)  # enough for the other one on a busy machine
    released = threading.Event()
    monkeypatch.setattr(tier.servers[1].worker, "search", lambda request: released.wait(60))
    for _ in range(4):
        assert_answers(ask(tier, places), places.brute_force(VECTOR, 100))
    released.set()


def test_engine_that_does_not_answer_is_reported_as_the_worker_does(
    places: SmallMap, tier_of: OpenTier, monkeypatch: pytest.MonkeyPatch
) -> None:
    tier = tier_of(1)
    refusing(tier.servers[0], monkeypatch, "engine_unavailable")
    with pytest.raises(Unavailable) as refused:
        ask(tier, places)
    assert refused.value.code == "engine_unavailable"


def test_a_search_that_begins_when_the_client_is_closed_is_unavailable(
    places: SmallMap, catalog: Catalog, store: FolderStore, settings: Settings
) -> None:
    with SearchTier(catalog, store, settings) as tier:
        pass
    with pytest.raises(Unavailable) as refused:
        ask(tier, places)
    assert refused.value.code == "search_unavailable"


# --- status -----------------------------------------------------------------------------------


def test_the_gateway_is_ready_while_a_search_worker_answers(
    places: SmallMap,
    tier_of: OpenTier,
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
) -> None:
    tier = tier_of(2)
    gateway = GatewayContext(
        catalog, store, InProcessWakeups(), tier.port, settings, LocalhostAuthenticator()
    )
    with TestClient(create_app(gateway), base_url="http://localhost") as client:
        assert client.get("/api/v1/health").json()["parts"]["search"] == {
            "status": "healthy",
            "detail": f"{len(places.rows)} rows in memory",
        }
        tier.servers[0].stop()
        assert client.get("/api/v1/health").json()["parts"]["search"]["status"] == "healthy"
        assert client.get("/readyz").status_code == 200
        tier.servers[1].stop()
        answer = client.get("/api/v1/health")
        assert (answer.status_code, answer.json()["status"]) == (503, "unhealthy")
        assert client.get("/readyz").status_code == 503
        for call in (tier.port.status, lambda: ask(tier, places)):
            with pytest.raises(Unavailable) as caught:
                call()
            assert caught.value.code == "search_unavailable"


def test_a_map_is_not_measured_while_the_engine_is_being_filled(
    places: SmallMap, tier_of: OpenTier, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    tier = tier_of(1)
    with catalog.write() as session:
        session.get_one(Photo, next(iter(places.rows))).place = "hall"
        generation = session.get_one(Generation, places.generation_id)
    scheme = LevelScheme(labels_are_paths=False, radii_m=(25.0,))
    measure = MapEvaluation(
        catalog, places.store, tier.port, generation, 25.0, scheme, Matching.OFF, lambda: None
    )
    sample = measure.draw_sample(1, 0)
    measure.evaluate(sample)
    search = tier.servers[0].worker.search

    def answer_in_part(request: SearchRequest) -> SearchResponse:
        part = {"missing": ("chunks/a/b.npy",), "filling": True, "certificate": "none"}
        return search(request).model_copy(update=part)

    monkeypatch.setattr(tier.servers[0].worker, "search", answer_in_part)
    with pytest.raises(Unavailable) as caught:
        measure.evaluate(sample)
    assert caught.value.code == "search_incomplete"


def test_a_worker_is_ready_once_it_has_loaded_what_answers(
    places: SmallMap,
    catalog: Catalog,
    store: FolderStore,
    tier_of: OpenTier,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tier = tier_of(1)
    server = tier.servers[0]
    server.stop()
    server.start()
    server.wait_until_started()

    def ready() -> tuple[int, Any]:
        answer = httpx2.get(f"{server.url}/readyz")
        return answer.status_code, answer.json()

    status, body = ready()
    assert (status, body["reasons"]) == (503, ["the catalog has not been read yet"])
    server.worker.sync()
    status, body = ready()
    assert (status, body["status"], body["reasons"]) == (200, "ready", [])
    (lag,) = body["lags"].values()
    assert lag["versions"] == 0
    assert 0 <= lag["seconds"] < 5

    with monkeypatch.context() as patched:
        patched.setattr(service, "MAX_READY_LAG_SECONDS", 0.0)
        status, body = ready()
        assert status == 503
        assert re.search("is 0 versions behind, last current .* s ago", body["reasons"][0])

    key = places.chunk_keys()[0]
    whole = store.get(key)
    store.put(key, whole[:-1])
    server.stop()
    server.start()
    server.wait_until_started()
    server.worker.sync()
    status, body = ready()
    assert (status, body["status"], body["missing"]) == (200, "degraded", [key])
    assert httpx2.get(f"{server.url}/livez").status_code == 200


def test_metrics_tell_searches_rows_versions_and_memory(
    places: SmallMap, tier_of: OpenTier
) -> None:
    tier = tier_of(1)
    ask(tier, places)
    ask(tier, places)
    with pytest.raises(Exception, match="no longer exists"):
        tier.port.search(places.request(("chunks/no/such.npy", 0)))
    text = httpx2.get(f"{tier.servers[0].url}/metrics").text
    figures = dict(re.findall(r"^(\w+(?:\{[^}]*\})?) (\S+)$", text, flags=re.MULTILINE))
    generation = f'{{generation="{places.generation_id}"}}'
    rows = len(places.rows)
    expected = {
        'placewise_search_searches_total{outcome="answered"}': 2,
        'placewise_search_searches_total{outcome="query_expired"}': 1,
        "placewise_search_seconds_count": 2,
        "placewise_search_rows_scanned_total": 2 * rows,
        "placewise_search_rows": rows,
        "placewise_search_resident_bytes": rows * 12 * 4,
        "placewise_search_missing_chunks": 0,
        f"placewise_search_snapshot_version{generation}": places.version,
        f"placewise_search_snapshot_lag_versions{generation}": 0,
    }
    assert {name: float(figures[name]) for name in expected} == expected
    assert float(figures[f"placewise_search_snapshot_lag_seconds{generation}"]) >= 0
