"""`rerank` and `explain`: what an extractor sees when it looks closely, and what becomes of it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from sqlalchemy import select

from services.extractor import describe
from services.extractor.worker import ExtractorWorker
from services.steward.tasks.garbage_collection import collect_ended_generations, collect_queries
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.chunks import find_descriptor_rows
from shared.catalog.database.session import Catalog
from shared.catalog.maps import get_or_create_default_map
from shared.config.settings import Settings
from shared.descriptors.reranking import rerank_score
from shared.ids import new_id
from shared.jobs import Job, JobKind, reclaim_expired_leases
from shared.storage import FolderStore, ObjectStore
from shared.storage.chunks import Row, read_row
from shared.storage.keys import comparison_key, query_key
from tests.integration.comparisons import (
    CLOSELY,
    begun,
    column,
    compared,
    fit,
    ids,
    jobs,
    lose_bytes,
    plain,
    release,
    result,
    searches,
)
from tests.integration.extractor.small_gpu import make_too_heavy
from tests.integration.in_process_api import Service
from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import field_refused, problem

# tests/e2e/test_rerank_and_explain.py does the same on SQLite.
pytestmark = pytest.mark.databases("postgresql")


@pytest.fixture
def settings(monkeypatch: pytest.MonkeyPatch) -> Settings:
    """Nobody works while a call waits: it is answered 202 at once."""
    monkeypatch.setenv("COMPARE_WAIT_SECONDS", "0")
    return Settings()


# --- what is answered ------------------------------------------------------------------------


def test_first_photos_are_ordered_by_their_rerank_scores_and_the_best_k_are_returned(
    service: Service,
) -> None:
    query = service.indexed(*range(7))[0]
    before = plain(service, query, top_k=6)
    assert column(before, "rerank_score") == column(before, "explanation") == [None] * 6
    started = begun(service, f"/similarity/{query}", top_k=6)
    job = service.json("GET", started["status_url"].removeprefix("/api/v1"))
    assert (job["kind"], job["state"], job["result"]) == ("compare", "queued", None)
    unfinished = service("GET", started["result_url"].removeprefix("/api/v1"))
    assert problem(unfinished, 409, "job_unfinished")["job_id"] == started["job_id"]
    service.drain()
    after = result(service, started)
    assert set(ids(after)[:3]) == set(ids(before)[:3])
    assert ids(after)[3:] == ids(before)[3:]
    scores = column(after, "rerank_score")
    assert scores[3:] == [None] * 3
    assert scores[:3] == sorted(scores[:3], reverse=True)
    similarity = dict(zip(ids(before), column(before, "similarity_score"), strict=True))
    for found in after["similar_images"]:
        assert found["similarity_score"] == similarity[found["image_id"]], "it is left alone"
        if found["rerank_score"] is not None:
            assert 0 <= found["rerank_score"] - found["similarity_score"] <= 0.5
    assert after["estimate"] == before["estimate"]
    assert after["processing_time_ms"] > 0
    assert result(service, started) == after
    assert searches(service) == 2, "one for each question, however often its answer is fetched"
    all_six = compared(service, query, top_k=6, rerank=6)
    best = compared(service, query, top_k=2, rerank=6)
    assert ids(best) == ids(all_six)[:2]
    assert best["total_similar"] == 2


def test_near_copy_is_raised_by_all_its_patches(service: Service) -> None:
    copy, original, *_ = [
        service.upload(data)["file_id"]
        for data in (near_copy(1), photo_bytes(1), photo_bytes(2), photo_bytes(3))
    ]
    service.drain()
    best, second, *_ = compared(service, copy)["similar_images"]
    assert best["image_id"] == original
    assert best["rerank_score"] - best["similarity_score"] > 0.2
    assert second["rerank_score"] - second["similarity_score"] < 0.2


def test_shares_of_clusters_add_up_to_the_similarity(service: Service) -> None:
    of_map = {"map": "words"}
    service.json("POST", "/maps", 201, json={"name": "words", "extractor": "test-tiny-vlad"})
    for number in range(5):
        service.upload(photo_bytes(number), "words")
    fit(service, "words", clusters=4)
    job_id = service.ask(near_copy(1), "words", explain="true", top_k=4)
    service.drain()
    path = f"/jobs/{job_id}/result"
    compare_job = service.json("GET", path, 202, params=of_map)
    service.drain()
    answer = service.json("GET", path, params=of_map)
    assert len(ids(answer)) == 4
    for found in answer["similar_images"]:
        shares = [one["share"] for one in found["explanation"]["clusters"]]
        assert sum(shares) == pytest.approx(found["similarity_score"], abs=1e-5)
        assert shares == sorted(shares, reverse=True)
        assert found["rerank_score"] is None, "nothing was to be reranked"
    assert compare_job["status_url"] == f"/api/v1/jobs/{compare_job['job_id']}?map=words"


def test_filters_and_least_score_hold_for_what_is_compared(service: Service) -> None:
    query = service.indexed(0, tags="x")[0]
    tagged = service.indexed(1, 2, 3, tags="a")
    service.indexed(4, 5)
    scores = column(plain(service, query, tags="a"), "similarity_score")
    answer = compared(service, query, tags="a", min_score=scores[1] - 1e-6, rerank=50)
    assert len(ids(answer)) == 2
    assert set(ids(answer)) < set(tagged)
    assert None not in column(answer, "rerank_score")


# --- parameters ------------------------------------------------------------------------------


def test_a_new_photo_is_described_and_compared_once_for_all_requests(service: Service) -> None:
    service.indexed(*range(5))
    described = service.ask(near_copy(1), **CLOSELY)
    service.drain()
    assert jobs(service, "compare") == []
    path = f"/jobs/{described}/result"
    first, again = service.json("GET", path, 202), service.json("GET", path, 202)
    assert first == again
    assert [job["job_id"] for job in jobs(service, "compare")] == [first["job_id"]]
    service.drain()
    answer = service.json("GET", path)
    assert answer["query_filename"] == "query.jpg"
    assert column(answer, "rerank_score")[0] is not None
    assert result(service, first) == answer
    assert searches(service) == 1


def test_comparison_repeated_under_its_key_is_one_job(service: Service) -> None:
    query = service.indexed(0, 1, 2)[0]
    key = {"Idempotency-Key": "key-1"}
    path = f"/similarity/{query}"
    first = service("POST", path, params=CLOSELY, headers=key)
    again = service("POST", path, params=CLOSELY, headers=key)
    assert first.status_code == again.status_code == 202
    assert again.headers["idempotent-replayed"] == "true"
    assert again.json() == first.json()
    assert again.headers["location"] == first.headers["location"] == first.json()["status_url"]
    assert len(jobs(service, "compare")) == 1
    other = service("POST", path, params={"rerank": 2}, headers=key)
    problem(other, 422, "idempotency_key_reused")


@pytest.mark.parametrize("rerank", [0, 51])
def test_depth_outside_its_bounds_is_refused(service: Service, rerank: object) -> None:
    query = service.indexed(0)[0]
    field_refused(service("POST", f"/similarity/{query}", params={"rerank": rerank}), "rerank")


def test_what_an_extractor_can_t_explain_is_refused_before_anything_is_queued(
    service: Service,
) -> None:
    name = "test-tiny-vlad:aggregator=gem"
    service.json("POST", "/maps", 201, json={"name": "gem", "extractor": name})
    photo = {"file": ("q.jpg", photo_bytes(1))}
    params = {"map": "gem", "explain": "true"}
    before_any = service("POST", "/similarity", params=params, files=photo)
    assert "GeM" in problem(before_any, 422, "not_explainable")["detail"]
    stored = service.indexed(1, 2, map_name="gem")[0]
    refused = service("POST", f"/similarity/{stored}", params=params)
    problem(refused, 422, "not_explainable")
    assert service.json("GET", "/jobs", params={"map": "gem", "kind": "compare"})["jobs"] == []
    started = service.json("POST", f"/similarity/{stored}", 202, params={"map": "gem", "rerank": 5})
    assert started["status"] == "queued"


def test_comparisons_wait_in_the_queue_of_queries(
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
) -> None:
    with catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)
    few = settings.model_copy(update={"max_queued_jobs": 200})
    service = Service(catalog, store, few, make_worker)
    query = service.indexed(0, 1)[0]
    begun(service, f"/similarity/{query}")
    refused = service("POST", f"/similarity/{query}", params=CLOSELY)
    problem(refused, 429, "queue_full")
    assert plain(service, query)["total_similar"] == 1, "what needs no extractor is answered"


def test_comparison_of_a_worker_that_was_given_up_is_ended_by_the_next_one(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    given_up: list[int] = []

    def score(*arguments: Any) -> float:
        if not given_up:
            with service.catalog.write() as session:
                given_up.append(reclaim_expired_leases(session, all_leases=True))
        return rerank_score(*arguments)

    query = service.indexed(0, 1, 2)[0]
    started = begun(service, f"/similarity/{query}")
    monkeypatch.setattr("services.extractor.comparison.rerank_score", score)
    assert service.worker.drain(threading.Event()).succeeded == 1
    assert given_up == [1]
    job = service.json("GET", f"/jobs/{started['job_id']}")
    assert (job["state"], job["attempts"]) == ("succeeded", 1)
    assert len(ids(result(service, started))) == 2


# --- what goes meanwhile ---------------------------------------------------------------------


def test_what_is_deleted_before_or_after_the_comparison_is_in_no_answer(service: Service) -> None:
    query, *others = service.indexed(*range(6))
    started = begun(service, f"/similarity/{query}", rerank=5)
    service.json("DELETE", f"/uploads/{others[0]}")
    service.drain()
    assert set(ids(result(service, started))) == set(others[1:])
    service.json("DELETE", f"/uploads/{others[1]}")
    answer = result(service, started)
    assert set(ids(answer)) == set(others[2:])
    assert answer["total_similar"] == 3


def test_query_that_is_deleted_before_the_comparison_is_not_found(service: Service) -> None:
    query = service.indexed(0, 1)[0]
    started = begun(service, f"/similarity/{query}")
    service.json("DELETE", f"/uploads/{query}")
    service.drain()
    answer = service("GET", started["result_url"].removeprefix("/api/v1"))
    assert problem(answer, 404, "photo_not_found")["job_id"] == started["job_id"]


def test_candidate_that_can_t_be_read_follows_those_that_can(service: Service) -> None:
    query = service.indexed(*range(5))[0]
    before = plain(service, query)
    lose_bytes(service, ids(before)[0])
    answer = compared(service, query)
    assert ids(answer)[2] == ids(before)[0]
    scores = column(answer, "rerank_score")
    assert None not in scores[:2]
    assert scores[2] is None
    assert None not in column(answer, "explanation"), "which needs its descriptor alone"


def test_candidate_that_the_gpu_can_not_hold_is_left_out_of_the_reranking_alone(
    service: Service, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    query, *others = service.indexed(*range(5))
    before = compared(service, query, rerank=4)
    heavy = others[2]
    make_too_heavy(monkeypatch, 3)
    answer = compared(service, query, rerank=4)
    assert ids(answer) == [one for one in ids(before) if one != heavy] + [heavy]
    scores = dict(zip(ids(before), column(before, "rerank_score"), strict=True))
    assert column(answer, "rerank_score") == [
        *(pytest.approx(scores[one]) for one in ids(answer)[:3]),
        None,
    ]
    (messages,) = [text for text in caplog.messages if "is not compared" in text]
    assert heavy in messages
    assert "The GPU ran out of memory" in messages
    assert jobs(service, "compare")[0]["state"] == "succeeded"


def test_candidate_whose_descriptor_is_damaged_is_compared_and_not_explained(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    query = service.indexed(*range(5))[0]
    before = plain(service, query)
    damaged = ids(before)[0]
    with service.catalog.read() as session:
        found = find_descriptor_rows(session, UUID(before["generation_id"]), [UUID(damaged)])
    ((at, ((number, _),)),) = found.items()

    def read(store: ObjectStore, key: str, row: int) -> Row:
        whole = read_row(store, key, row)
        return (whole / 2).astype(np.float32) if (key, row) == (at, number) else whole

    monkeypatch.setattr(describe, "read_row", read)
    answer = compared(service, query)
    assert set(ids(answer)) == set(ids(before))
    for found_photo in answer["similar_images"]:
        assert (found_photo["explanation"] is None) == (found_photo["image_id"] == damaged)


def test_generation_that_was_replaced_is_compared_until_it_is_gone(service: Service) -> None:
    of_map = {"map": "words"}
    service.json("POST", "/maps", 201, json={"name": "words", "extractor": "test-tiny-vlad"})
    uploaded = [service.upload(photo_bytes(n), "words")["file_id"] for n in range(5)]
    fit(service, "words", clusters=4)
    path, params = f"/similarity/{uploaded[0]}", {**of_map, **CLOSELY}
    replaced = service.json("POST", path, 202, params=params)
    gone = service.json("POST", path, 202, params={**params, "top_k": 2})
    answering = plain(service, uploaded[0], **of_map)["generation_id"]
    # Left in the queue while the model changes: its jobs come after these, so they are held back.
    with service.catalog.write() as session:
        for job in session.scalars(select(Job).where(Job.kind == JobKind.COMPARE)):
            job.waiting_for = "search"
    fit(service, "words", clusters=3)
    release(service, replaced)
    answer = service.json("GET", f"/jobs/{replaced['job_id']}/result", params=of_map)
    assert answer["generation_id"] == answering
    assert answering != plain(service, uploaded[0], **of_map)["generation_id"]
    assert column(answer, "explanation")[0]["clusters"]
    collect_ended_generations(service.catalog, service.store, -60)
    release(service, gone)
    refused = service("GET", f"/jobs/{gone['job_id']}/result", params=of_map)
    problem(refused, 410, "query_expired")


def test_query_photo_that_is_no_longer_kept_is_gone(service: Service) -> None:
    service.indexed(0, 1)
    described = service.ask(near_copy(1), **CLOSELY)
    service.drain()
    started = service.json("GET", f"/jobs/{described}/result", 202)
    service.store.delete(query_key(UUID(described)))
    service.drain()
    for job_id in (started["job_id"], described):
        problem(service("GET", f"/jobs/{job_id}/result"), 410, "query_expired")


def test_nothing_is_left_of_a_comparison_after_its_time(service: Service) -> None:
    query = service.indexed(0, 1, 2)[0]
    started = begun(service, f"/similarity/{query}")
    service.drain()
    key = comparison_key(UUID(started["job_id"]))
    service.store.put(comparison_key(new_id()), b"an orphan")
    assert collect_orphans(service.catalog, service.store, -60) == 1
    assert service.store.head(key) is not None
    collect_queries(service.catalog, service.store, 3600)
    assert service.store.head(key) is not None
    collect_queries(service.catalog, service.store, -60)
    assert list(service.store.list("queries/")) == []
    assert jobs(service, "compare") == []
    problem(service("GET", started["result_url"].removeprefix("/api/v1")), 404, "job_not_found")
