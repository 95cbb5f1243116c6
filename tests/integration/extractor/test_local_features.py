"""LOCAL_FEATURES=keep: local features are made once, and go with what they belong to."""

from __future__ import annotations

from uuid import UUID

import pytest

from services.steward.tasks.delete_maps import purge_deleted_maps
from services.steward.tasks.garbage_collection import (
    collect_deleted_photos,
    collect_ended_generations,
)
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.generations import active_generation
from shared.catalog.maps import get_map
from shared.config.settings import Settings
from shared.ids import new_id
from shared.storage.keys import local_features_key
from tests.integration.comparisons import (
    column,
    compared,
    feature_keys,
    fit,
    ids,
    lose_bytes,
    plain,
)
from tests.integration.in_process_api import Service
from tests.support.photos import photo_bytes

# tests/e2e/test_rerank_and_explain.py does the same on SQLite.
pytestmark = pytest.mark.databases("postgresql")

WORDS = "test-tiny-vlad"


@pytest.fixture
def settings(monkeypatch: pytest.MonkeyPatch) -> Settings:
    monkeypatch.setenv("COMPARE_WAIT_SECONDS", "0")
    monkeypatch.setenv("LOCAL_FEATURES", "keep")
    return Settings()


def generation_of(service: Service, map_name: str = "default") -> UUID:
    with service.catalog.read() as session:
        found = active_generation(session, get_map(session, map_name).id)
    assert found is not None
    return found.id


def keys(service: Service, photo_ids: list[str], map_name: str = "default") -> set[str]:
    generation_id = generation_of(service, map_name)
    return {local_features_key(generation_id, UUID(photo_id)) for photo_id in photo_ids}


def test_kept_features_give_the_same_scores_without_the_photos(service: Service) -> None:
    query = service.indexed(*range(5))[0]
    first = compared(service, query)
    assert feature_keys(service) == keys(service, ids(first)[:3]), "of what was reranked, no more"
    for photo_id in ids(first):
        lose_bytes(service, photo_id)
    again = compared(service, query)
    assert ids(again) == ids(first)
    assert column(again, "rerank_score") == column(first, "rerank_score")


def test_damaged_features_are_made_anew(service: Service) -> None:
    query = service.indexed(0, 1)[0]
    first = compared(service, query)
    (key,) = feature_keys(service)
    whole = service.store.get(key)
    service.store.put(key, whole[:-7])
    assert column(compared(service, query), "rerank_score") == column(first, "rerank_score")
    assert service.store.get(key) == whole


def test_kept_features_go_with_their_photo(service: Service) -> None:
    query = service.indexed(0, 1, 2)[0]
    gone, stays = ids(compared(service, query))
    service.json("DELETE", f"/uploads/{gone}")
    collect_deleted_photos(service.catalog, service.store, 3600)
    assert feature_keys(service) == keys(service, [stays])


def test_kept_features_go_with_their_generation_and_with_their_map(service: Service) -> None:
    service.json("POST", "/maps", 201, json={"name": "words", "extractor": WORDS})
    query, *others = [service.upload(photo_bytes(n), "words")["file_id"] for n in range(3)]
    fit(service, "words", clusters=4)
    compared(service, query, "words")
    of_first = keys(service, others, "words")
    assert feature_keys(service) == of_first
    fit(service, "words", clusters=3)
    collect_ended_generations(service.catalog, service.store, 3600)
    assert feature_keys(service) == of_first, "in its grace it may still be compared"
    collect_ended_generations(service.catalog, service.store, -60)
    assert feature_keys(service) == set()
    compared(service, query, "words")
    assert feature_keys(service) == keys(service, others, "words")
    service.json("DELETE", "/maps/words")
    purge_deleted_maps(service.catalog, service.store)
    assert feature_keys(service) == set()


def test_features_that_no_one_needs_are_orphans(service: Service) -> None:
    query = service.indexed(0, 1, 2)[0]
    gone, stays = ids(compared(service, query))
    service.json("DELETE", f"/uploads/{gone}")
    for key in (
        local_features_key(new_id(), UUID(stays)),
        local_features_key(generation_of(service), new_id()),
        "features/stray",
    ):
        service.store.put(key, b"?")
    collect_orphans(service.catalog, service.store, -60)
    assert feature_keys(service) == keys(service, [stays])


def test_full_store_keeps_nothing_and_compares_all_the_same(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    from shared.errors import StorageFull
    from shared.storage import FolderStore

    real = FolderStore.put

    def put(self: FolderStore, key: str, data: bytes) -> None:
        if key.startswith("features/"):
            raise StorageFull("disk_full", "There is no room.")
        real(self, key, data)

    query = service.indexed(0, 1, 2)[0]
    monkeypatch.setattr(FolderStore, "put", put)
    assert None not in column(compared(service, query), "rerank_score")
    assert feature_keys(service) == set()
    assert plain(service, query)["total_similar"] == 2
