"""Search over several machines: failures, lag, placement, and status."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from typing import Any, BinaryIO
from uuid import UUID

import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient

from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from services.search import service
from services.steward.map_evaluation import MapEvaluation
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.maps import Matching
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.errors import Unavailable
from shared.evaluation.places.levels import LevelScheme
from shared.jobs import InProcessWakeups
from shared.search_api.photo_filter import PhotoFilter
from shared.search_api.protocol import SearchRequest, SearchResponse
from shared.storage import FolderStore
from shared.storage.chunks import decode_rows, encode_rows
from tests.support.search_tier import SearchServer, SearchTier
from tests.support.small_map import SmallMap, assert_answers, unit_rows
from tests.support.waiting import wait_until

pytestmark = pytest.mark.databases("postgresql")

SLOTS = 7  # three shards have three, two and two of them
BACK_SECONDS = 20.0  # for a worker that was started again to be seen: about one, in truth
VECTOR = unit_rows(1000, 1)[0]


@pytest.fixture
def places(catalog: Catalog, store: FolderStore) -> SmallMap:
    """Photos in every slot."""
    made = SmallMap(catalog, store)
    for slot in range(SLOTS):
        made.add(unit_rows(slot, 3), slot)
    return made


OpenTier = Callable[..., SearchTier]


@pytest.fixture
def tier_of(catalog: Catalog, store: FolderStore, settings: Settings) -> Any:
    """Opens tiers with so many replicas of each shard; each has loaded everything."""
    opened: list[SearchTier] = []

    def open_tier(*replicas: int, **changes: float) -> SearchTier:
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


def slots_of(places: SmallMap) -> dict[UUID, int]:
    """Every live photo's slot, as the catalog has it."""
    with places.catalog.read() as session:
        return {
            photo_id: session.get_one(
                Chunk, session.get_one(Descriptor, (places.generation_id, photo_id)).chunk_id
            ).slot
            for photo_id in places.rows
        }


def photos_of(server: SearchServer) -> set[UUID]:
    """The photos that the worker has in memory."""
    snapshots = server.worker._snapshots.values()
    return {
        photo_id
        for snapshot in snapshots
        for chunk in snapshot.chunks
        for photo_id in chunk.photos.photo_id[chunk.photos.findable]
    }


# --- who dies --------------------------------------------------------------------------------


def test_a_killed_shard_is_named_and_the_others_answer_until_it_is_back(
    places: SmallMap, tier_of: OpenTier
) -> None:
    tier = tier_of(1, 1, 1)
    everything = places.brute_force(VECTOR, 100)
    assert_answers(ask(tier, places), everything)

    tier.servers[1][0].stop()
    slots = slots_of(places)
    rest = [hit for hit in everything if slots[hit[0]] % 3 != 1]
    response = ask(tier, places)
    assert response.missing == ("shard 1/3",)
    assert response.certificate == "none"
    assert_answers(response, rest)
    assert len(rest) < len(everything)
    assert tier.port.status().unavailable == ("shard 1/3",)

    tier.servers[1][0].start()
    wait_until(lambda: not ask(tier, places).missing, BACK_SECONDS)
    assert_answers(ask(tier, places), everything)
    assert tier.port.status().unavailable == ()


def test_searches_continue_when_a_replica_is_killed(places: SmallMap, tier_of: OpenTier) -> None:
    tier = tier_of(2, 2)
    everything = places.brute_force(VECTOR, 100)
    tier.servers[0][0].stop()
    tier.servers[1][1].stop()
    for _ in range(8):  # whichever replica is first
        response = ask(tier, places)
        assert response.missing == ()
        assert_answers(response, everything)
    assert tier.port.status().unavailable == ()


# --- who lags --------------------------------------------------------------------------------


def behind(server: SearchServer, monkeypatch: pytest.MonkeyPatch) -> list[SearchRequest]:
    """Let the worker never reach the requested version; the requests that it gets."""
    requests: list[SearchRequest] = []

    def search(request: SearchRequest) -> SearchResponse:
        requests.append(request)
        raise Unavailable("search_behind", "Search has not caught up.")

    monkeypatch.setattr(server.worker, "search", search)
    return requests


def test_every_shard_answers_at_least_the_requested_version(
    places: SmallMap, tier_of: OpenTier
) -> None:
    tier = tier_of(1, 2, 1)
    for seed in range(4):
        places.add(VECTOR[np.newaxis] + unit_rows(seed, 1) / 10, slot=seed % 3)
        places.delete(next(iter(places.rows)))
        response = ask(tier, places)
        assert response.snapshot_version == places.version
        assert {hit.photo_id for hit in response.hits} == set(places.rows)


def test_the_current_replica_answers_while_the_other_is_behind(
    places: SmallMap, tier_of: OpenTier, monkeypatch: pytest.MonkeyPatch
) -> None:
    tier = tier_of(1, 2)
    searched = behind(tier.servers[1][0], monkeypatch)
    for _ in range(10):
        response = ask(tier, places)
        assert response.missing == ()
        assert_answers(response, places.brute_force(VECTOR, 100))
    assert searched, "the replica that is behind was never tried first"


def test_a_shard_that_stays_behind_is_named_at_the_deadline(
    places: SmallMap, tier_of: OpenTier, monkeypatch: pytest.MonkeyPatch
) -> None:
    tier = tier_of(1, 1, timeout_seconds=2.0)  # enough for the other one on a busy machine
    searched = behind(tier.servers[0][0], monkeypatch)
    started = time.monotonic()
    response = ask(tier, places)
    assert response.missing == ("shard 0/2",)
    assert response.hits
    assert len(searched) > 2, "it was not retried"
    assert time.monotonic() - started < 10


def test_a_search_worker_that_hangs_leaves_only_its_shard_missing(
    places: SmallMap, tier_of: OpenTier, monkeypatch: pytest.MonkeyPatch
) -> None:
    tier = tier_of(1, 1, timeout_seconds=2.0)  # enough for the other one on a busy machine
    released = threading.Event()
    monkeypatch.setattr(tier.servers[1][0].worker, "search", lambda request: released.wait(60))
    response = ask(tier, places)
    released.set()
    assert response.missing == ("shard 1/2",)
    assert response.hits


# --- what is where ---------------------------------------------------------------------------


def test_each_photo_is_in_one_shard_and_merging_moves_none(
    places: SmallMap, tier_of: OpenTier
) -> None:
    tier = tier_of(1, 1, 1)
    for slot in range(SLOTS):
        places.add(unit_rows(100 + slot, 2), slot)
    tier.follow()
    before = [photos_of(shard[0]) for shard in tier.servers]
    assert sum(len(photos) for photos in before) == len(places.rows)
    assert set.union(*before) == set(places.rows)
    slots = slots_of(places)
    assert all(slots[photo_id] % 3 == i for i, photos in enumerate(before) for photo_id in photos)

    places.delete(next(iter(before[0])))
    assert all(places.merge(slot) for slot in range(SLOTS))
    tier.follow()
    after = [photos_of(shard[0]) for shard in tier.servers]
    assert after == [photos & set(places.rows) for photos in before]
    assert_answers(ask(tier, places), places.brute_force(VECTOR, 100))


def test_a_query_row_of_another_shard_is_read_alone_and_kept(
    places: SmallMap, tier_of: OpenTier, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    tier = tier_of(1, 1, 1)
    held = [server[0].worker.status().resident_bytes for server in tier.servers]
    photo_id = next(id_ for id_, slot in slots_of(places).items() if slot == 4)
    request = places.request(places.reference(photo_id), k=5, exclude=(photo_id,))
    opened: list[str] = []
    real = store.open

    def open_(key: str) -> BinaryIO:
        opened.append(key)
        return real(key)

    monkeypatch.setattr(store, "open", open_)
    first = tier.port.search(request)
    assert_answers(first, places.brute_force(places.rows[photo_id], 6)[1:])
    assert opened == [request.object_key] * 2, "once by each of the shards that don't hold it"
    assert tier.port.search(request) == first
    assert len(opened) == 2
    assert [s[0].worker.status().resident_bytes for s in tier.servers] == held


def test_a_damaged_query_row_of_another_shard_is_not_compared(
    places: SmallMap, tier_of: OpenTier, store: FolderStore
) -> None:
    """Its owner would notice by the chunk's hash, but its owner is away."""
    tier = tier_of(1, 1)
    photo_id = next(id_ for id_, slot in slots_of(places).items() if slot == 1)
    key, row = places.reference(photo_id)
    damaged = decode_rows(store.get(key)).copy()
    damaged[row, 3] += 0.2
    store.put(key, encode_rows(damaged))
    tier.servers[1][0].stop()
    with pytest.raises(Unavailable) as caught:
        tier.port.search(places.request((key, row)))
    assert caught.value.code == "chunk_unreadable"
    assert caught.value.extra["object_key"] == key


def test_a_filter_is_applied_in_every_shard(places: SmallMap, tier_of: OpenTier) -> None:
    tier = tier_of(1, 1, 1)
    reference = tuple(list(places.rows)[::4])
    response = ask(tier, places, photos=PhotoFilter(ids=reference))
    expected = [hit for hit in places.brute_force(VECTOR, 100) if hit[0] in reference]
    assert_answers(response, expected)
    assert response.rows_scanned == len(reference)


# --- status -----------------------------------------------------------------------------------


def test_the_gateways_health_names_shards_without_workers_and_it_is_ready_while_there_is_one(
    places: SmallMap,
    tier_of: OpenTier,
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
) -> None:
    tier = tier_of(1, 2)
    gateway = GatewayContext(
        catalog, store, InProcessWakeups(), tier.port, settings, LocalhostAuthenticator()
    )
    with TestClient(create_app(gateway), base_url="http://localhost") as client:
        assert client.get("/api/v1/health").json()["parts"]["search"] == {
            "status": "healthy",
            "detail": f"{len(places.rows)} rows in memory",
        }
        tier.servers[0][0].stop()
        tier.servers[1][0].stop()  # its shard has another one
        answer = client.get("/api/v1/health")
        assert (answer.status_code, answer.json()["status"]) == (503, "degraded")
        assert answer.json()["parts"]["search"] == {
            "status": "degraded",
            "detail": "no search worker is available for: shard 0/2",
        }
        assert client.get("/readyz").status_code == 200
        tier.servers[1][1].stop()
        answer = client.get("/api/v1/health")
        assert (answer.status_code, answer.json()["status"]) == (503, "unhealthy")
        assert client.get("/readyz").status_code == 503
        for call in (tier.port.status, lambda: ask(tier, places)):
            with pytest.raises(Unavailable) as caught:
                call()
            assert caught.value.code == "search_unavailable"


def test_a_map_is_not_measured_while_a_shard_is_missing(
    places: SmallMap, tier_of: OpenTier, catalog: Catalog
) -> None:
    tier = tier_of(1, 1)
    with catalog.write() as session:
        session.get_one(Photo, next(iter(places.rows))).place = "hall"
        generation = session.get_one(Generation, places.generation_id)
    scheme = LevelScheme(labels_are_paths=False, radii_m=(25.0,))
    measure = MapEvaluation(
        catalog, tier.port, generation, 25.0, scheme, Matching.OFF, lambda: None
    )
    sample = measure.draw_sample(1, 0)
    measure.evaluate(sample)
    tier.servers[1][0].stop()
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
    server = tier.servers[0][0]
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
    text = httpx2.get(f"{tier.servers[0][0].url}/metrics").text
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
