"""Evaluations that are cancelled, killed or taken over, and their HTTP API."""

from __future__ import annotations

import threading
from uuid import UUID

import pytest

from shared.catalog.database.session import Catalog
from shared.catalog.generations import Evaluation
from shared.catalog.jobs import get_job
from shared.catalog.maps import Search, get_map
from shared.jobs import JobState, progress
from shared.jobs.runner import reclaim_expired_leases
from shared.jobs.transitions import cancel_job, retry_job
from shared.storage import read_retries
from tests.integration.evaluated_map import EvaluatedMap, Watched
from tests.integration.in_process_api import Service
from tests.integration.steward.streets import STREETS, WITHOUT_PLACE
from tests.support.catalog_rows import add_generation, expire_lease, failure_code, read_job
from tests.support.photos import photo_bytes
from tests.support.problems import field_refused, problem

pytestmark = pytest.mark.databases("postgresql")


@pytest.fixture
def look_always(monkeypatch: pytest.MonkeyPatch) -> None:
    """The evaluator looks at its job after every question."""
    monkeypatch.setattr(progress, "PROGRESS_SECONDS", 0.0)


def cancel(city: EvaluatedMap, job_id: UUID) -> None:
    with city.catalog.write() as session:
        cancel_job(get_job(session, city.map_id, job_id, lock=True))


@pytest.mark.usefixtures("look_always")
def test_a_cancelled_evaluation_ends_soon_and_leaves_nothing(city: EvaluatedMap) -> None:
    city.publish(STREETS)
    job_id = city.start()

    search = Watched(city.search, 2, lambda: cancel(city, job_id))
    assert city.work(search)
    assert len(search.searches) <= 3
    assert read_job(city.catalog, job_id).state == JobState.CANCELLED
    assert city.evaluations() == []
    assert city.calibration() is None
    assert not city.work()


def test_an_evaluation_cancelled_at_the_last_moment_leaves_nothing(city: EvaluatedMap) -> None:
    city.publish(STREETS)
    job_id = city.start()

    city.work(Watched(city.search, len(STREETS), lambda: cancel(city, job_id)))
    assert read_job(city.catalog, job_id).state == JobState.CANCELLED
    assert (city.evaluations(), city.calibration()) == ([], None)
    with city.catalog.write() as session:
        retry_job(session, get_job(session, city.map_id, job_id, lock=True))
    assert city.work()
    assert len(city.evaluations()) == 1


def test_a_stopping_steward_gives_its_evaluation_to_the_next_one(city: EvaluatedMap) -> None:
    city.publish(STREETS)
    job_id = city.start()
    stop = threading.Event()
    search = Watched(city.search, 2, stop.set)
    assert city.work(search, stop)
    assert len(search.searches) == 2
    job = read_job(city.catalog, job_id)
    assert (job.state, job.attempts, job.lease_token) == (JobState.QUEUED, 0, None)
    assert city.evaluations() == []
    assert city.work()
    assert read_job(city.catalog, job_id).state == JobState.SUCCEEDED


def test_an_evaluator_whose_lease_was_taken_over_commits_nothing(city: EvaluatedMap) -> None:
    city.publish(STREETS)
    job_id = city.start()

    def take_over() -> None:
        expire_lease(city.catalog, job_id)
        with city.catalog.write() as session:
            reclaim_expired_leases(session)
        assert city.work()

    assert city.work(Watched(city.search, 3, take_over))
    assert len(city.evaluations()) == 1
    assert read_job(city.catalog, job_id).state == JobState.SUCCEEDED


@pytest.mark.parametrize("order", [0, 1])
def test_a_damaged_map_is_not_measured_by_its_rest(
    city: EvaluatedMap, order: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether the broken chunk holds query photos, or only photos that may be found."""
    monkeypatch.setattr(read_retries, "FIRST_RETRY_SECONDS", 0.0)
    city.publish(STREETS)
    city.publish(WITHOUT_PLACE)
    keys = sorted(
        (info.key for info in city.store.list("chunks/") if info.key.endswith(".npy")),
        key=lambda key: city.store.path(key).stat().st_mtime_ns,
    )
    whole = city.store.get(keys[order])
    city.store.put(keys[order], whole[:-1])
    job_id = city.start()
    assert city.work()
    job = read_job(city.catalog, job_id)
    assert failure_code(job) == "map_damaged"
    assert keys[order] in str(job.error)
    assert city.evaluations() == []
    city.store.put(keys[order], whole)
    city.search.sync()
    assert city.figures()["leave_one_out"]["R@1"] == 2 / 8


def test_there_must_be_something_to_evaluate(service: Service) -> None:
    def refused() -> None:
        body = problem(service("POST", "/evaluations"), 409, "nothing_to_evaluate")
        assert "coordinates or a place" in body["detail"]

    refused()
    service.indexed(1)
    refused()
    service.indexed(2, role="query", latitude=1, longitude=2)
    refused()
    service.upload(photo_bytes(3), place="hall")
    refused()
    service.drain()
    job = service.json("POST", "/evaluations", 202)
    assert job["status_url"] == f"/api/v1/jobs/{job['job_id']}"
    read = service.json("GET", f"/jobs/{job['job_id']}")
    assert (read["kind"], read["state"]) == ("evaluate", "queued")


@pytest.mark.parametrize("params", [{"sample": 0}, {"seed": -1}, {"radius": 5}])
def test_bad_fields_are_refused_by_name(service: Service, params: dict[str, int]) -> None:
    field_refused(service("POST", "/evaluations", json=params), *params)


@pytest.mark.parametrize("path", ["evaluations", "searches"])
def test_a_cursor_shows_each_row_once_while_new_ones_arrive(
    service: Service, catalog: Catalog, path: str
) -> None:
    with catalog.write() as session:
        map_id = get_map(session, "default").id
        generation_id = add_generation(session, map_id).id

    def arrive() -> None:
        with catalog.write() as session:
            session.add(
                Evaluation(
                    map_id=map_id,
                    generation_id=generation_id,
                    searchable=1,
                    labelled_queries=0,
                    figures={},
                )
                if path == "evaluations"
                else Search(
                    map_id=map_id,
                    generation_id=generation_id,
                    query_filename="q.jpg",
                    top_k=1,
                    results=0,
                    processing_ms=1.0,
                )
            )

    name = {"evaluations": "evaluation_id", "searches": "search_id"}[path]
    for _ in range(7):
        arrive()
    everything = service.json("GET", f"/{path}", params={"limit": 100})
    assert everything["next_cursor"] is None
    expected = [row[name] for row in everything[path]]
    assert expected == sorted(expected, reverse=True)
    assert len(expected) == 7
    seen: list[str] = []
    cursor: dict[str, str] = {}
    while True:
        page = service.json("GET", f"/{path}", params={"limit": 2, **cursor})
        seen += [row[name] for row in page[path]]
        if page["next_cursor"] is None:
            break
        cursor = {"cursor": page["next_cursor"]}
        arrive()
    assert seen == expected
    field_refused(service("GET", f"/{path}", params={"cursor": "no-cursor"}), "cursor")
