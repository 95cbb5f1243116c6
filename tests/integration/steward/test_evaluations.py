"""Evaluations: exact figures of a map laid out by hand, and what disturbs the one who counts."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

import pytest
import sqlalchemy as sql

from services.steward import evaluation_worker as asked_module
from services.steward.tasks.auto_evaluation import evaluate_changed_maps
from services.steward.tasks.compaction import merge_slot
from services.steward.tasks.garbage_collection import collect_superseded_chunks
from shared.catalog.base import db_now
from shared.catalog.chunks import Descriptor
from shared.catalog.generations import Evaluation, Generation, GenerationState
from shared.catalog.jobs import get_job
from shared.catalog.maps import Search, get_map, increment_map_version, lock_map
from shared.catalog.photos import Photo, PhotoRole
from shared.catalog.session import Catalog
from shared.errors import Unavailable
from shared.jobs import JobKind, JobState, reclaim_expired_leases
from shared.jobs.transitions import cancel_job, fail_job, retry_job
from shared.search_api.protocol import SearchRequest, SearchResponse, SearchStatus
from shared.storage import FolderStore, read_retries
from tests.integration.in_process_api import Service
from tests.integration.town import Seen, Town, Watched, metres_north
from tests.support.catalog_rows import (
    add_generation,
    add_job,
    add_photo,
    delete,
    end_pauses,
    expire_lease,
    read_job,
    set_columns,
)
from tests.support.photos import photo_bytes
from tests.support.problems import field_refused, problem

NOON = datetime(2024, 5, 6, 12, tzinfo=UTC)
HOUR = timedelta(hours=1)
LEAST = 20


@pytest.fixture
def town(catalog: Catalog, store: FolderStore) -> Town:
    return Town(catalog, store)


def at(latitude: float, metres: float = 0, **columns: Any) -> dict[str, Any]:
    """Taken on a meridian, some metres north of a latitude."""
    return {"latitude": latitude + metres_north(metres), "longitude": 7.0, **columns}


def query(**columns: Any) -> dict[str, Any]:
    return {"role": PhotoRole.QUERY, **columns}


# By angle; every ranking of a photo is the others by their distance round the circle. Right means
# within 25 m, or the same label.
STREETS: list[Seen] = [
    (0, at(0)),  # its place comes second (B before it): R@5
    (10, at(0, 24)),  # second as well: R@5
    (4, at(1)),  # its place comes behind all that is near: not even among ten
    (100, at(1, 10)),  # third, after 50 and 10: R@5
    (50, at(2, place="yard")),  # alone, and counted once though it has both
    (200, {"place": "hall"}),  # first: R@1
    (201, {"place": "hall", **at(30)}),  # first, by the label; it also has coordinates
    (300, at(3)),  # six strangers lie between the two: R@10
    (312, at(3, 24.9)),
    *((301 + n, at(10 + n)) for n in range(6)),  # each alone
]
WITHOUT_PLACE: list[Seen] = [(150, {}), (340, {})]  # found, but nothing to ask about


# --- figures ---------------------------------------------------------------------------------


def test_leave_one_out_recall_is_what_one_counts_by_hand(town: Town) -> None:
    town.publish(STREETS)
    town.publish(WITHOUT_PLACE)
    figures = town.figures()
    assert figures["leave_one_out"] == {
        "queries": 8,
        "R@1": 2 / 8,
        "R@5": 5 / 8,
        "R@10": 7 / 8,
        "without_positive": 7,
    }
    assert figures["labelled_queries"] is None
    assert figures["radius_m"] == 25
    (evaluation,) = town.evaluations()
    assert figures == {
        "evaluation_id": str(evaluation.id),
        "generation_id": str(town.generation_id),
        **evaluation.figures,
    }
    assert (evaluation.searchable, evaluation.labelled_queries) == (17, 0)
    assert not evaluation.automatic
    assert town.calibration() is not None


def test_a_little_farther_than_the_radius_is_another_place(town: Town) -> None:
    town.publish([(0, at(0)), (1, at(0, 24.9)), (90, at(1)), (91, at(1, 25.1))])
    loo = town.figures()["leave_one_out"]
    assert (loo["queries"], loo["R@1"], loo["without_positive"]) == (2, 1, 2)


def test_labelled_queries_are_counted_in_and_out_of_the_map(town: Town) -> None:
    town.publish(STREETS)
    town.publish(
        [
            (1, query(**at(0, 5))),  # the first is right
            (3, query(**at(1, 5))),  # the first is right
            (120, query(place="hall")),  # third, after 100 and 50
            (30, query(**at(45))),  # nowhere
            (210, query(place="kitchen")),  # no such label
            (60, query()),  # no one knows where: not asked
        ]
    )
    labelled = town.figures()["labelled_queries"]
    assert labelled["queries"] == 3
    assert (labelled["R@1"], labelled["R@5"], labelled["R@10"]) == (2 / 3, 1, 1)
    assert labelled["out_of_map"] == 2
    assert labelled["same_session"] == 0
    assert labelled["median_error_of_right_ones_m"] < 25
    (evaluation,) = town.evaluations()
    assert (evaluation.searchable, evaluation.labelled_queries) == (15, 5)


def test_labelled_queries_do_not_disturb_leave_one_out(town: Town) -> None:
    town.publish(STREETS)
    before = town.figures()["leave_one_out"]
    town.publish([(n, query(**at(0))) for n in range(0, 360, 30)])
    assert town.figures()["leave_one_out"] == before


def test_a_sample_is_of_its_size_and_comes_from_its_seed(town: Town) -> None:
    town.publish([(7 * n, at(n)) for n in range(30)])  # each alone
    asked = [_asked(town, sample=10, seed=seed) for seed in (1, 1, 2)]
    # The sample comes first; then the neighbours of the photos that it finds.
    assert asked[0] == asked[1]
    assert set(asked[0][:10]) != set(asked[2][:10])
    assert all(10 <= len(ids) < 30 for ids in asked)
    assert len(_asked(town, sample=1000, seed=0)) == 30


def _asked(town: Town, **params: Any) -> list[UUID]:
    """Which photos an evaluation asks with, in their order, each once."""
    seen: dict[UUID, None] = {}
    search = town.search.search

    class Noting:
        def search(self, request: SearchRequest) -> SearchResponse:
            seen.update(dict.fromkeys(request.exclude))
            return search(request)

        def status(self) -> SearchStatus:
            return town.search.status()

    town.start(**params)
    assert town.work(Noting())
    return list(seen)


@pytest.mark.parametrize(
    ("later", "same"),
    [(0 * HOUR, True), (11.9 * HOUR, True), (-11.9 * HOUR, True), (12 * HOUR, False)],
)
def test_queries_of_the_session_of_their_match_teach_no_confidence(
    town: Town, later: timedelta, same: bool
) -> None:
    """40 of them are right and 20 wrong: enough to learn from, if they were of another day."""
    town.publish([(6 * n, at(n, captured_at=NOON)) for n in range(60)])
    town.publish(
        [
            (6 * n + 1, query(**at(n if n < 40 else n - 20, captured_at=NOON + later)))
            for n in range(60)
        ]
    )
    figures = town.figures()
    assert figures["labelled_queries"]["same_session"] == (60 if same else 0)
    calibration = town.calibration()
    assert calibration is not None
    assert calibration["labelled_queries"] == (0 if same else 60)
    expected = "uncalibrated" if same else "calibrated"
    assert figures["estimate"]["calibration"] == expected
    assert (figures["labelled_queries"]["auroc"] is None) == same


def test_a_photo_deleted_meanwhile_counts_neither_way(town: Town, catalog: Catalog) -> None:
    photo_ids = town.publish([(0, at(0)), (1, at(0)), (90, at(1)), (91, at(1))])
    asking = town.publish([(2, query(**at(0))), (92, query(**at(1)))])
    job_id = town.start()

    def delete_some() -> None:
        for gone in (photo_ids[3], asking[1]):
            delete(catalog, town.map_id, gone)
            _forget(catalog, gone)

    town.work(Watched(town.search, 1, delete_some))
    result = read_job(catalog, job_id).result
    assert result is not None
    assert result["leave_one_out"]["queries"] == 3
    assert result["leave_one_out"]["R@1"] == pytest.approx(2 / 3), "the pair of the gone one"
    assert (result["labelled_queries"]["queries"], result["labelled_queries"]["R@1"]) == (1, 1)


def _forget(catalog: Catalog, photo_id: UUID) -> None:
    with catalog.write() as session:
        session.execute(sql.delete(Descriptor).where(Descriptor.photo_id == photo_id))


def test_chunks_merged_and_removed_meanwhile_change_no_figure(town: Town) -> None:
    """The photo that is asked with has another reference then: it is looked up once more."""
    for begin in range(0, len(STREETS), 3):
        town.publish(STREETS[begin : begin + 3])
    before = town.figures()["leave_one_out"]

    def merge() -> None:
        assert merge_slot(town.catalog, town.store, town.generation_id, 0)
        collect_superseded_chunks(town.catalog, town.store, grace_seconds=0)
        town.search.sync()

    job_id = town.start()
    town.work(Watched(town.search, 4, merge))
    result = read_job(town.catalog, job_id).result
    assert result is not None
    assert result["leave_one_out"] == before


# --- ended early -----------------------------------------------------------------------------


@pytest.fixture
def look_always(monkeypatch: pytest.MonkeyPatch) -> None:
    """The evaluator looks at its job after every question."""
    monkeypatch.setattr(asked_module, "PROGRESS_INTERVAL_SECONDS", -1.0)


@pytest.mark.usefixtures("look_always")
def test_a_cancelled_evaluation_ends_soon_and_leaves_nothing(town: Town) -> None:
    town.publish(STREETS)
    job_id = town.start()

    def cancel_it() -> None:
        with town.catalog.write() as session:
            cancel_job(get_job(session, town.map_id, job_id, lock=True))

    search = Watched(town.search, 2, cancel_it)
    assert town.work(search)
    assert search.asked <= 3
    assert read_job(town.catalog, job_id).state == JobState.CANCELLED
    assert town.evaluations() == []
    assert town.calibration() is None
    assert not town.work()


def test_an_evaluation_cancelled_at_the_last_moment_leaves_nothing(town: Town) -> None:
    town.publish(STREETS)
    job_id = town.start()

    def cancel_it() -> None:
        with town.catalog.write() as session:
            cancel_job(get_job(session, town.map_id, job_id, lock=True))

    town.work(Watched(town.search, len(STREETS), cancel_it))
    assert read_job(town.catalog, job_id).state == JobState.CANCELLED
    assert (town.evaluations(), town.calibration()) == ([], None)
    with town.catalog.write() as session:
        retry_job(session, get_job(session, town.map_id, job_id, lock=True))
    assert town.work()
    assert len(town.evaluations()) == 1


def test_a_stopping_steward_gives_its_evaluation_to_the_next_one(town: Town) -> None:
    town.publish(STREETS)
    job_id = town.start()
    stop = threading.Event()
    search = Watched(town.search, 2, stop.set)
    assert town.work(search, stop)
    assert search.asked == 2
    job = read_job(town.catalog, job_id)
    assert (job.state, job.attempts, job.lease_token) == (JobState.QUEUED, 0, None)
    assert town.evaluations() == []
    assert town.work()
    assert read_job(town.catalog, job_id).state == JobState.SUCCEEDED


class Killed(BaseException):
    pass


def kill() -> None:
    raise Killed


def test_a_killed_evaluation_begins_anew(town: Town) -> None:
    town.publish(STREETS)
    job_id = town.start()
    with pytest.raises(Killed):
        town.work(Watched(town.search, 5, kill))
    assert not town.work(), "its lease is not over"
    expire_lease(town.catalog, job_id)
    with town.catalog.write() as session:
        assert reclaim_expired_leases(session, max_attempts=3) == 1
    search = Watched(town.search, 0, kill)
    assert town.work(search)
    assert search.asked >= len(STREETS)
    job = read_job(town.catalog, job_id)
    assert job.state == JobState.SUCCEEDED
    assert job.progress_done == job.progress_total == len(STREETS)
    (evaluation,) = town.evaluations()
    assert evaluation.figures["leave_one_out"]["R@10"] == 7 / 8


def test_an_evaluator_whose_lease_was_taken_over_commits_nothing(town: Town) -> None:
    town.publish(STREETS)
    job_id = town.start()

    def take_over() -> None:
        expire_lease(town.catalog, job_id)
        with town.catalog.write() as session:
            reclaim_expired_leases(session, max_attempts=3)
        assert town.work()

    assert town.work(Watched(town.search, 3, take_over))
    assert len(town.evaluations()) == 1
    assert read_job(town.catalog, job_id).state == JobState.SUCCEEDED


def test_an_evaluation_waits_while_search_is_away(town: Town) -> None:
    town.publish(STREETS)
    job_id = town.start()

    def away() -> None:
        raise Unavailable("search_behind", "Search has not caught up.")

    assert town.work(Watched(town.search, 3, away))
    job = read_job(town.catalog, job_id)
    assert (job.state, job.attempts) == (JobState.QUEUED, 0)
    assert job.run_after is not None
    assert not town.work(), "it pauses"
    end_pauses(town.catalog)
    assert town.work()
    assert read_job(town.catalog, job_id).state == JobState.SUCCEEDED


def test_an_evaluation_that_crashes_is_tried_again_and_fails_in_the_end(town: Town) -> None:
    town.publish(STREETS)
    job_id = town.start()

    def crash() -> None:
        raise ZeroDivisionError

    for _ in range(3):
        assert town.work(Watched(town.search, 1, crash))
    job = read_job(town.catalog, job_id)
    assert (job.state, job.attempts) == (JobState.FAILED, 3)
    assert job.error is not None
    assert "ZeroDivisionError" in job.error["detail"]


@pytest.mark.parametrize("order", [0, 1])
def test_a_damaged_map_is_not_measured_by_its_rest(
    town: Town, order: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether the broken chunk holds photos that are asked with or only such as may be found."""
    monkeypatch.setattr(read_retries, "FIRST_RETRY_SECONDS", 0.0)
    town.publish(STREETS)
    town.publish(WITHOUT_PLACE)
    keys = sorted(
        (info.key for info in town.store.list("chunks/") if info.key.endswith(".npy")),
        key=lambda key: town.store.path(key).stat().st_mtime_ns,
    )
    whole = town.store.get(keys[order])
    town.store.put(keys[order], whole[:-1])
    job_id = town.start()
    assert town.work()
    job = read_job(town.catalog, job_id)
    assert job.state == JobState.FAILED
    assert job.error is not None
    assert job.error["code"] == "map_damaged"
    assert keys[order] in job.error["detail"]
    assert town.evaluations() == []
    town.store.put(keys[order], whole)
    town.search.sync()
    assert town.figures()["leave_one_out"]["R@1"] == 2 / 8


# --- by themselves ---------------------------------------------------------------------------


def automatic(town: Town, least_photos: int = LEAST) -> bool:
    """Whether the steward queues an evaluation now; it is done at once."""
    before = len(town.evaluation_jobs())
    for _ in range(2):  # the second time there is always one under way
        evaluate_changed_maps(town.catalog, least_photos, word_weights=True)
    jobs = town.evaluation_jobs()[before:]
    assert len(jobs) <= 1
    if jobs:
        assert town.work()
        assert read_job(town.catalog, jobs[0].id).state == JobState.SUCCEEDED
        assert town.evaluations()[-1].automatic
    return bool(jobs)


def test_a_map_is_evaluated_by_itself_once_per_change(town: Town) -> None:
    town.publish([(n, at(n)) for n in range(LEAST - 1)])
    assert not automatic(town), "too few"
    town.publish([(90, {})])
    assert not automatic(town), "one more, but no one knows where"
    photo_ids = town.publish([(91, at(50))])
    assert automatic(town)
    assert not automatic(town)
    photo_ids += town.publish([(100 + n, at(60 + n)) for n in range(4)])
    assert not automatic(town), "a fifth and no more"
    photo_ids += town.publish([(110, at(70))])
    assert automatic(town)
    assert not automatic(town)
    town.publish([(200, query(**at(0)))])
    assert automatic(town), "the first labelled query"
    assert not automatic(town)
    for photo_id in photo_ids:
        delete(town.catalog, town.map_id, photo_id)
    assert not automatic(town), "too few again"


def test_queries_that_can_not_be_asked_do_not_count_as_a_change(town: Town) -> None:
    """They would be one for ever: no evaluation asks with them."""
    town.publish([(n, at(n)) for n in range(LEAST)])
    assert automatic(town)
    town.publish([(200 + n, query()) for n in range(5)])
    with town.catalog.write() as session:
        add_photo(session, town.map_id, **query(**at(3)))  # not described
    assert not automatic(town)


def test_an_automatic_evaluation_is_not_for_every_map_setting_or_moment(town: Town) -> None:
    photo_ids = town.publish([(n, at(n)) for n in range(LEAST)])
    assert not automatic(town, least_photos=0), "0: never"
    assert not automatic(town, least_photos=LEAST + 1)
    with town.catalog.write() as session:
        photo_id = add_photo(session, town.map_id).id
        job = add_job(session, town.map_id, photo_id=photo_id)
    assert not automatic(town), "photos are being described"
    set_columns(town.catalog, job.id, state=JobState.FAILED)
    with town.catalog.write() as session:
        lock_map(session, town.map_id)
        session.get_one(Photo, photo_ids[0]).role = PhotoRole.QUERY
        increment_map_version(session, town.map_id)
    assert not automatic(town), "one of them has become a query"
    town.publish([(77, at(77))])
    with town.catalog.write() as session:
        add_job(session, town.map_id, JobKind.DESCRIBE)
    assert automatic(town), "someone's question changes nothing"


@pytest.mark.parametrize("end", ["fails", "is cancelled"])
@pytest.mark.parametrize("earlier", [False, True])
def test_an_evaluation_that_came_to_nothing_is_not_tried_again_before_the_next_change(
    town: Town, earlier: bool, end: str
) -> None:
    town.publish([(n, at(n)) for n in range(LEAST)])
    if earlier:
        assert automatic(town)
        town.publish([(100 + n, at(40 + n)) for n in range(LEAST)])
    done = len(town.evaluation_jobs())
    evaluate_changed_maps(town.catalog, LEAST, word_weights=True)
    job = town.evaluation_jobs()[-1]
    with town.catalog.write() as session:
        mine = get_job(session, town.map_id, job.id, lock=True)
        cancel_job(mine) if end == "is cancelled" else fail_job(mine, {"code": "out_of_luck"})
    for _ in range(3):
        evaluate_changed_maps(town.catalog, LEAST, word_weights=True)
    assert len(town.evaluation_jobs()) == done + 1
    town.publish([(200 + n, at(-40 + n)) for n in range(2 * LEAST)])
    assert automatic(town)
    assert not automatic(town)


def test_a_new_generation_is_a_change(town: Town) -> None:
    town.publish([(n, at(n)) for n in range(LEAST)])
    assert automatic(town)
    with town.catalog.write() as session:
        old = session.get_one(Generation, town.generation_id)
        old.state, old.ended_at = GenerationState.RETIRED, db_now()
        session.flush()
        town.generation_id = add_generation(session, town.map_id, dimension=2).id
    town.publish([(n, at(n)) for n in range(LEAST)])
    assert automatic(town)
    assert not automatic(town)
    assert [e.generation_id == town.generation_id for e in town.evaluations()] == [False, True]


def test_two_stewards_queue_one_evaluation(town: Town) -> None:
    town.publish([(n, at(n)) for n in range(LEAST)])
    together = threading.Barrier(4)

    def look() -> None:
        together.wait()
        for _ in range(3):
            evaluate_changed_maps(town.catalog, LEAST, word_weights=True)

    with ThreadPoolExecutor(4) as pool:
        for look_ in [pool.submit(look) for _ in range(4)]:
            look_.result()
    assert len(town.evaluation_jobs()) == 1


def test_each_map_is_evaluated_for_itself(town: Town, catalog: Catalog, store: FolderStore) -> None:
    other = Town(catalog, store, "other")
    town.publish([(n, at(n)) for n in range(LEAST)])
    other.publish([(n, at(n)) for n in range(LEAST - 1)])
    assert automatic(town)
    assert (len(town.evaluations()), len(other.evaluations())) == (1, 0)
    assert (town.calibration() is None, other.calibration() is None) == (False, True)


# --- over HTTP -------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("wanted", "field"),
    [
        ({"sample": 0}, "sample"),
        ({"sample": 1_000_001}, "sample"),
        ({"sample": 1.5}, "sample"),
        ({"sample": "many"}, "sample"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**31}, "seed"),
        ({"radius": 5}, "radius"),
    ],
)
def test_bad_numbers_are_refused_by_name(
    service: Service, wanted: dict[str, Any], field: str
) -> None:
    field_refused(service("POST", "/evaluations", json=wanted), field)


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
