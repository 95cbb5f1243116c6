"""Deleting a map: gone at once for people, and in the end from every table and the store."""

from __future__ import annotations

import io
import threading
from collections import Counter
from functools import partial
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from services.extractor.generation_resolver import reindex_outdated_generations
from services.extractor.model_registry import ModelRegistry
from services.steward.evaluation_worker import EvaluationWorker
from services.steward.tasks import delete_maps
from services.steward.tasks.compaction import merge_small_chunks
from services.steward.tasks.delete_maps import purge_deleted_maps
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.batch_items import BatchItem
from shared.catalog.chunks import Chunk
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, active_generation
from shared.catalog.maps import cache_map_statistics
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.extractor_config.configs import MIN_PHOTOS_TO_FIT
from shared.jobs import Job, JobKind
from shared.storage import FolderStore
from shared.storage.keys import new_checkpoint_key
from tests.integration.gateway.deleted_maps import ROUNDS, id_of, objects, remove_all, rows
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_job, add_photo, add_reconstruction
from tests.support.checkpoints import none_added
from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import problem
from tests.support.threads import at_once

pytestmark = pytest.mark.databases("postgresql")


class Away(Exception):
    pass


def live_in(service: Service, name: str) -> None:
    """Everything that can belong to a map: photos, found and failed and asking ones, a vocabulary
    and an import under way, generations, a whitening, searches, queries, tracks, evaluations."""
    settings = Settings()
    service.json("POST", "/maps", 201, json={"name": name, "extractor": "test-tiny-vlad"})
    params = {"map": name}
    for number in (1, 2, 3):
        service.upload(photo_bytes(number), name, latitude=number, longitude=7)
    service.upload(photo_bytes(4), name, role="query", place="hall")
    service.upload(photo_bytes(5)[:-60], name)  # it can't be decoded
    service.done(service("POST", "/vocabularies", params=params, json={"clusters": 4}), name)
    oldest = service.json("GET", "/search", params={**params, "role": "database"})["images"][-1]
    service.json("DELETE", f"/uploads/{oldest['image_id']}", params=params)
    found = service.json("GET", "/search", params={**params, "role": "query"})["images"]
    service.json("POST", f"/similarity/{found[0]['image_id']}", params=params)
    service.ask(near_copy(2), name)
    service.drain()
    service.json("POST", "/evaluations", 202, params=params)
    stored = service.catalog, service.store
    evaluator = EvaluationWorker(*stored, service.search, settings, "evaluator")
    assert evaluator.run_next(threading.Event())
    service.done(
        service("POST", "/vocabularies", params=params, json={"clusters": 3, "seed": 5}), name
    )
    service.done(service("POST", "/generations", params=params, json={"pca": 1}), name)
    with service.catalog.write() as session:
        cache_map_statistics(session, id_of(service, name))
    buffer = io.BytesIO()
    np.save(buffer, np.ones((4, 99), np.float32))
    files = {"file": ("centres.npy", buffer.getvalue())}
    service.json("POST", "/vocabularies/import", 202, params=params, files=files)
    service.ask(near_copy(3), name)
    track_id = service.json("POST", "/tracks", 201, params=params, json={})["track_id"]
    frame = {"data": {"captured_at": "2026-05-01T12:00Z"}, "files": {"file": near_copy(1)}}
    service.json("POST", f"/tracks/{track_id}/frames", 202, params=params, **frame)
    service.upload(photo_bytes(6), name)
    files = {"file": ("batch.jpg", photo_bytes(7))}
    service.json("POST", "/upload/batch", 202, params=params, files=files)
    with service.catalog.write() as session:
        active = active_generation(session, id_of(service, name))
        assert active is not None
        job = add_job(
            session, active.map_id, JobKind.RECONSTRUCT, params={"object_key": new_checkpoint_key()}
        )
        made = add_reconstruction(session, service.store, active)
        made.job_id, made.finished_at = job.id, None
        service.store.put(job.params["object_key"], b"a COLMAP model")


def test_choosing_a_vocabulary_switches_automatic_fits_off(service: Service) -> None:
    service.json("POST", "/maps", 201, json={"name": "quay", "extractor": "test-tiny-vlad"})
    made = service.json("GET", "/maps/quay")
    assert (made["auto_fit"], made["next_fit_photos"]) == (True, MIN_PHOTOS_TO_FIT)
    service.indexed(1, 2, map_name="quay")
    params = {"map": "quay"}
    for seed in (0, 1):
        service.done(service("POST", "/vocabularies", params=params, json={"seed": seed}), "quay")
    _, oldest = service.json("GET", "/vocabularies", params=params)
    assert service.json("GET", "/maps/quay")["auto_fit"] is True
    body = {"vocabulary_id": oldest["vocabulary_id"]}
    service.done(service("POST", "/generations", params=params, json=body), "quay")
    chosen = service.json("GET", "/maps/quay")
    assert (chosen["auto_fit"], chosen["next_fit_photos"]) == (False, None)
    again = service.json("PATCH", "/maps/quay", json={"auto_fit": True})
    assert (again["auto_fit"], again["next_fit_photos"]) == (True, MIN_PHOTOS_TO_FIT)
    service.done(service("POST", "/generations", params=params, json=body), "quay")  # without PCA
    assert service.json("GET", "/maps/quay")["auto_fit"] is True
    average = service.json("GET", "/maps/default")
    assert average["next_fit_photos"] is None, "its extractor uses no vocabulary"


def test_matching_on_starts_a_model_change_where_photos_have_no_local_features(
    service: Service,
) -> None:
    service.json("POST", "/maps", 201, json={"name": "quay", "matching": "off"})
    made = service.json("PATCH", "/maps/quay", json={"matching": "on"})
    assert (made["matching"], made["local_features"], made["model_change_id"]) == ("on", None, None)
    service.json("PATCH", "/maps/quay", json={"matching": "off"})
    service.indexed(1, 2, map_name="quay")
    before = service.json("GET", "/maps/quay")
    features = {"model": None, "photos": 0, "missing": 2, "bytes": 0, "used": None}
    assert (before["local_features"], before["model_change_id"]) == (features, None)
    changed = service.json("PATCH", "/maps/quay", json={"matching": "on"})
    assert changed["model_change_id"] is not None
    again = service("PATCH", "/maps/quay", json={"matching": "on"})
    problem(again, 409, "model_change_running")
    service.ended(changed["model_change_id"], "quay")
    after = service.json("GET", "/maps/quay")
    assert after["generation_id"] != before["generation_id"]
    assert after["local_features"]["photos"] == 2
    assert after["local_features"]["missing"] == 0
    assert after["local_features"]["bytes"] > 0
    assert service.json("PATCH", "/maps/quay", json={"matching": "on"})["model_change_id"] is None
    response = service("PATCH", "/maps/quay", json={"matching": "sometimes"})
    problem(response, 422, "invalid_field")


# --- what people see -------------------------------------------------------------------------


@pytest.mark.databases("sqlite", "postgresql")
def test_a_deleted_map_leaves_no_row_and_no_byte_and_others_stay(
    service: Service, catalog: Catalog, store: FolderStore
) -> None:
    service.indexed(1, 2)
    live_in(service, "other")
    service.drain()  # nothing of it is left to do: from here on it stays as it is
    before = rows(catalog), objects(store)
    generation = service.json("GET", "/maps/other")["generation_id"]
    live_in(service, "gone")
    assert service.json("GET", "/maps/other")["generation_id"] == generation
    during = rows(catalog)
    of_no_map = {
        *("installation", "idempotency_keys", "api_keys", "live_processes"),
        *("webhooks", "webhook_deliveries"),
    }
    assert all(during[table] > before[0][table] for table in during.keys() - of_no_map), during
    kinds = {"originals", "thumbnails", "chunks", "queries", "vocabularies", "whitenings", "work"}
    kinds |= {"checkpoints", "reconstructions"}
    assert kinds >= {key.split("/")[0] for key in objects(store) - before[1]}
    service.json("DELETE", "/maps/gone")
    problem(service("GET", "/maps/gone"), 404, "map_not_found")
    remove_all(catalog, store)
    assert rows(catalog) == before[0]
    assert {key for key in objects(store) if not key.startswith("work/")} == {
        key for key in before[1] if not key.startswith("work/")
    }
    collect_orphans(catalog, store, 0)
    found = service.json("GET", "/search", params={"map": "other", "role": "query"})["images"]
    answer = service.json("POST", f"/similarity/{found[0]['image_id']}", params={"map": "other"})
    assert answer["total_similar"] == 3


def test_the_name_of_a_deleted_map_is_free_at_once(
    service: Service, catalog: Catalog, store: FolderStore
) -> None:
    service.json("POST", "/maps", 201, json={"name": "town"})
    old = service.indexed(1, 2, map_name="town")
    removed = id_of(service, "town")
    service.json("DELETE", "/maps/town")
    kept_as = {"map": f"deleted/{removed}"}  # its row's name, which no one may ask for
    problem(service("GET", "/search", params=kept_as), 404, "map_not_found")
    made = service.json("POST", "/maps", 201, json={"name": "town"})
    assert (made["photos"], made["searchable"], made["generation_id"]) == (0, 0, None)
    (new,) = service.indexed(1, map_name="town")
    problem(service("GET", f"/uploads/{old[0]}", params={"map": "town"}), 404, "photo_not_found")
    remove_all(catalog, store)
    assert service("GET", f"/uploads/{new}/image", params={"map": "town"}).content == photo_bytes(1)
    answer = service.json("POST", f"/similarity/{new}", params={"map": "town"})
    assert answer["similar_images"] == []


def test_a_deleted_default_map_is_created_again_empty(
    service: Service, catalog: Catalog, store: FolderStore
) -> None:
    service.indexed(1, 2)
    old = id_of(service, "default")
    assert service.json("DELETE", "/maps/default")["deleted_map"] == "default"
    stats = service.json("GET", "/database/stats")
    assert (stats["total_images"], stats["searchable_images"], stats["map_version"]) == (0, 0, 0)
    assert id_of(service, "default") != old
    (new,) = service.indexed(1)
    remove_all(catalog, store)
    assert service.json("GET", f"/uploads/{new}")["searchable"]
    assert rows(catalog)["maps"] == 1


@pytest.mark.databases("sqlite", "postgresql")
def test_concurrent_deletions_delete_a_map_once(service: Service) -> None:
    service.json("POST", "/maps", 201, json={"name": "town"})
    answers = at_once(*[lambda: service("DELETE", "/maps/town").status_code] * 4)
    assert set(answers) <= {200, 404}
    assert 200 in answers
    service.json("POST", "/maps", 201, json={"name": "town"})


@pytest.mark.databases("sqlite", "postgresql")
def test_concurrent_creations_create_a_map_once(service: Service) -> None:
    answers = at_once(*[lambda: service("POST", "/maps", json={"name": "town"}).status_code] * 4)
    assert sorted(answers) == [201, 409, 409, 409]


# --- removing --------------------------------------------------------------------------------


def test_a_removal_that_is_killed_at_any_step_resumes(
    service: Service, catalog: Catalog, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each round dies one deletion later than the one before; objects go before their rows."""
    before = rows(catalog), objects(store)
    live_in(service, "gone")
    service.json("DELETE", "/maps/gone")
    real = FolderStore.delete
    for allowed in range(ROUNDS):
        left = iter(range(allowed))

        def delete(self: FolderStore, key: str, left: Any = left) -> None:
            if next(left, None) is None:
                raise Away
            real(self, key)

        with monkeypatch.context() as patched:
            patched.setattr(FolderStore, "delete", delete)
            try:
                purge_deleted_maps(catalog, store)
            except Away:
                _check_remembered(catalog, store)
                continue
        break
    else:
        raise AssertionError("it never ended")
    assert allowed > 3, "several rounds were cut short"
    remove_all(catalog, store)
    assert rows(catalog) == before[0]
    assert {key for key in objects(store) if not key.startswith("work/")} == before[1]


def _check_remembered(catalog: Catalog, store: FolderStore) -> None:
    """Whatever still lies in the store is named by a row, so that it will go."""
    with catalog.read() as session:
        originals = set(session.scalars(select(Photo.object_key)))
        originals |= set(session.scalars(select(BatchItem.object_key)))
        chunks = set(session.scalars(select(Chunk.object_key)))
    lying = objects(store)
    assert {key for key in lying if key.startswith("originals/")} <= originals
    assert {key for key in lying if key.startswith("chunks/") and key.endswith(".npy")} <= chunks


def test_a_large_map_is_removed_in_several_transactions(
    service: Service, catalog: Catalog, store: FolderStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delete_maps, "ROWS_PER_TRANSACTION", 10)
    monkeypatch.setattr(delete_maps, "CHUNKS_PER_STEP", 1)
    service.json("POST", "/maps", 201, json={"name": "gone"})
    before = rows(catalog)
    for number in range(3):
        service.indexed(number, map_name="gone")
    with catalog.write() as session:
        for _ in range(25):
            add_photo(session, id_of(service, "gone"))
    service.json("DELETE", "/maps/gone")
    remove_all(catalog, store)
    assert rows(catalog) == Counter({**before, "maps": before["maps"] - 1})
    assert objects(store) == set()


def test_two_stewards_remove_a_map_together(
    service: Service, catalog: Catalog, store: FolderStore
) -> None:
    before = rows(catalog)
    live_in(service, "gone")
    service.json("DELETE", "/maps/gone")
    at_once(*[partial(remove_all, catalog, store)] * 2)
    assert rows(catalog) == before


def test_a_map_under_removal_is_not_compacted_reindexed_or_loaded(
    service: Service, catalog: Catalog, store: FolderStore, settings: Settings
) -> None:
    service.json("POST", "/maps", 201, json={"name": "gone"})
    for number in range(2):
        service.indexed(number, map_name="gone")
    with catalog.write() as session:
        for generation in session.scalars(select(Generation)):
            generation.spec_fingerprint = "made by another release"
    service.search.sync()
    assert service.search.status().rows == 2
    service.json("DELETE", "/maps/gone")
    service.search.sync()
    assert service.search.status().resident_bytes == 0
    assert merge_small_chunks(catalog, store, settings, compact_chunks=2) == 0
    assert reindex_outdated_generations(catalog, ModelRegistry(store, settings, none_added)) == 0
    with catalog.read() as session:
        kinds = set(session.scalars(select(Job.kind)))
    assert kinds == {JobKind.INDEX}
