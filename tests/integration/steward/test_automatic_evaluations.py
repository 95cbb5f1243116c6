"""Automatic evaluations after changes of a map."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from services.steward.tasks.auto_evaluation import evaluate_changed_maps
from shared.catalog.database.base import db_now
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import get_job
from shared.catalog.maps import increment_map_version, lock_map
from shared.catalog.photos import Photo, PhotoRole
from shared.config.settings import Settings
from shared.extractor_config.configs import MIN_PHOTOS_TO_FIT
from shared.jobs import JobKind, JobState
from shared.jobs.transitions import cancel_job, fail_job
from shared.storage import FolderStore
from tests.integration.steward.streets import at, query
from tests.integration.town import Town
from tests.support.catalog_rows import (
    add_generation,
    add_job,
    add_photo,
    delete,
    read_job,
    set_columns,
)

LEAST = Settings().auto_evaluate_photos


def automatic(town: Town, least_photos: int = LEAST) -> bool:
    """Whether the steward queues an evaluation now; it is done at once."""
    before = len(town.evaluation_jobs())
    for _ in range(2):  # the second time there is always one under way
        evaluate_changed_maps(
            town.catalog, Settings().model_copy(update={"auto_evaluate_photos": least_photos})
        )
    jobs = town.evaluation_jobs()[before:]
    assert len(jobs) <= 1
    if jobs:
        assert town.work()
        assert read_job(town.catalog, jobs[0].id).state == JobState.SUCCEEDED
        assert town.evaluations()[-1].automatic
    return bool(jobs)


def test_a_map_is_evaluated_again_when_its_labels_become_paths(town: Town) -> None:
    town.publish([(n, {"place": f"hall {n % 4}"}) for n in range(LEAST)])
    assert automatic(town)
    assert not automatic(town)
    with town.catalog.write() as session:
        map_ = lock_map(session, town.map_id)
        map_.place_labels_are_paths, map_.place_labels_are_automatic = True, False
    assert automatic(town)
    assert not automatic(town)


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


def test_queries_that_can_not_be_searched_do_not_count_as_a_change(town: Town) -> None:
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


@pytest.mark.parametrize(("earlier", "end"), [(False, "fails"), (True, "is cancelled")])
def test_an_evaluation_that_came_to_nothing_is_not_tried_again_before_the_next_change(
    town: Town, earlier: bool, end: str
) -> None:
    town.publish([(n, at(n)) for n in range(LEAST)])
    if earlier:
        assert automatic(town)
        town.publish([(100 + n, at(40 + n)) for n in range(LEAST)])
    done = len(town.evaluation_jobs())
    evaluate_changed_maps(town.catalog, Settings())
    job = town.evaluation_jobs()[-1]
    with town.catalog.write() as session:
        mine = get_job(session, town.map_id, job.id, lock=True)
        cancel_job(mine) if end == "is cancelled" else fail_job(mine, {"code": "out_of_luck"})
    for _ in range(3):
        evaluate_changed_maps(town.catalog, Settings())
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
            evaluate_changed_maps(town.catalog, Settings())

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


def test_a_map_that_waits_for_its_vocabulary_is_evaluated_after_the_fit(town: Town) -> None:
    with town.catalog.write() as session:
        lock_map(session, town.map_id).extractor = "efficientnet-lite0-vlad128"
    town.publish([(n, at(n)) for n in range(MIN_PHOTOS_TO_FIT)])
    assert not automatic(town), "the fit makes a generation that is evaluated anyway"
    with town.catalog.write() as session:
        lock_map(session, town.map_id).fitted_photos = MIN_PHOTOS_TO_FIT
    assert automatic(town)
