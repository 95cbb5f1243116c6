"""Automatic evaluations after changes of a map."""

from __future__ import annotations

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
from tests.integration.evaluated_map import EvaluatedMap
from tests.integration.steward.streets import at, query
from tests.support.catalog_rows import (
    add_generation,
    add_job,
    add_photo,
    delete,
    read_job,
    set_columns,
)
from tests.support.threads import at_once

LEAST = Settings().auto_evaluate_photos


def automatic(city: EvaluatedMap, least_photos: int = LEAST) -> bool:
    """Whether the steward queues an evaluation now; it is done at once."""
    before = len(city.evaluation_jobs())
    for _ in range(2):  # the second time there is always one under way
        evaluate_changed_maps(
            city.catalog, Settings().model_copy(update={"auto_evaluate_photos": least_photos})
        )
    jobs = city.evaluation_jobs()[before:]
    assert len(jobs) <= 1
    if jobs:
        assert city.work()
        assert read_job(city.catalog, jobs[0].id).state == JobState.SUCCEEDED
        assert city.evaluations()[-1].automatic
    return bool(jobs)


def test_a_map_is_evaluated_again_when_its_labels_become_paths(city: EvaluatedMap) -> None:
    city.publish([(n, {"place": f"hall {n % 4}"}) for n in range(LEAST)])
    assert automatic(city)
    assert not automatic(city)
    with city.catalog.write() as session:
        map_ = lock_map(session, city.map_id)
        map_.place_labels_are_paths, map_.place_labels_are_automatic = True, False
    assert automatic(city)
    assert not automatic(city)


def test_a_map_is_evaluated_by_itself_once_per_change(city: EvaluatedMap) -> None:
    city.publish([(n, at(n)) for n in range(LEAST - 1)])
    assert not automatic(city), "too few"
    city.publish([(90, {})])
    assert not automatic(city), "one more, but no one knows where"
    photo_ids = city.publish([(91, at(50))])
    assert automatic(city)
    assert not automatic(city)
    photo_ids += city.publish([(100 + n, at(60 + n)) for n in range(4)])
    assert not automatic(city), "a fifth and no more"
    photo_ids += city.publish([(110, at(70))])
    assert automatic(city)
    assert not automatic(city)
    city.publish([(200, query(**at(0)))])
    assert automatic(city), "the first labelled query"
    assert not automatic(city)
    for photo_id in photo_ids:
        delete(city.catalog, city.map_id, photo_id)
    assert not automatic(city), "too few again"


def test_queries_that_can_not_be_searched_do_not_count_as_a_change(city: EvaluatedMap) -> None:
    """They would be one for ever: no evaluation asks with them."""
    city.publish([(n, at(n)) for n in range(LEAST)])
    assert automatic(city)
    city.publish([(200 + n, query()) for n in range(5)])
    with city.catalog.write() as session:
        add_photo(session, city.map_id, **query(**at(3)))  # not described
    assert not automatic(city)


def test_an_automatic_evaluation_is_not_for_every_map_setting_or_moment(city: EvaluatedMap) -> None:
    photo_ids = city.publish([(n, at(n)) for n in range(LEAST)])
    assert not automatic(city, least_photos=0), "0: never"
    assert not automatic(city, least_photos=LEAST + 1)
    with city.catalog.write() as session:
        photo_id = add_photo(session, city.map_id).id
        job = add_job(session, city.map_id, photo_id=photo_id)
    assert not automatic(city), "photos are being described"
    set_columns(city.catalog, job.id, state=JobState.FAILED)
    with city.catalog.write() as session:
        lock_map(session, city.map_id)
        session.get_one(Photo, photo_ids[0]).role = PhotoRole.QUERY
        increment_map_version(session, city.map_id)
    assert not automatic(city), "one of them has become a query"
    city.publish([(77, at(77))])
    with city.catalog.write() as session:
        add_job(session, city.map_id, JobKind.DESCRIBE)
    assert automatic(city), "someone's question changes nothing"


@pytest.mark.parametrize(("earlier", "end"), [(False, "fails"), (True, "is cancelled")])
def test_an_evaluation_that_came_to_nothing_is_not_tried_again_before_the_next_change(
    city: EvaluatedMap, earlier: bool, end: str
) -> None:
    city.publish([(n, at(n)) for n in range(LEAST)])
    if earlier:
        assert automatic(city)
        city.publish([(100 + n, at(40 + n)) for n in range(LEAST)])
    done = len(city.evaluation_jobs())
    evaluate_changed_maps(city.catalog, Settings())
    job = city.evaluation_jobs()[-1]
    with city.catalog.write() as session:
        mine = get_job(session, city.map_id, job.id, lock=True)
        cancel_job(mine) if end == "is cancelled" else fail_job(mine, {"code": "out_of_luck"})
    for _ in range(3):
        evaluate_changed_maps(city.catalog, Settings())
    assert len(city.evaluation_jobs()) == done + 1
    city.publish([(200 + n, at(-40 + n)) for n in range(2 * LEAST)])
    assert automatic(city)
    assert not automatic(city)


def test_a_new_generation_is_a_change(city: EvaluatedMap) -> None:
    city.publish([(n, at(n)) for n in range(LEAST)])
    assert automatic(city)
    with city.catalog.write() as session:
        old = session.get_one(Generation, city.generation_id)
        old.state, old.ended_at = GenerationState.RETIRED, db_now()
        session.flush()
        city.generation_id = add_generation(session, city.map_id, dimension=2).id
    city.publish([(n, at(n)) for n in range(LEAST)])
    assert automatic(city)
    assert not automatic(city)
    assert [e.generation_id == city.generation_id for e in city.evaluations()] == [False, True]


def test_two_stewards_queue_one_evaluation(city: EvaluatedMap) -> None:
    city.publish([(n, at(n)) for n in range(LEAST)])

    def look() -> None:
        for _ in range(3):
            evaluate_changed_maps(city.catalog, Settings())

    at_once(*[look] * 4)
    assert len(city.evaluation_jobs()) == 1


def test_each_map_is_evaluated_for_itself(
    city: EvaluatedMap, catalog: Catalog, store: FolderStore
) -> None:
    other = EvaluatedMap(catalog, store, "other")
    city.publish([(n, at(n)) for n in range(LEAST)])
    other.publish([(n, at(n)) for n in range(LEAST - 1)])
    assert automatic(city)
    assert (len(city.evaluations()), len(other.evaluations())) == (1, 0)
    assert (city.calibration() is None, other.calibration() is None) == (False, True)


def test_a_map_that_waits_for_its_vocabulary_is_evaluated_after_the_fit(city: EvaluatedMap) -> None:
    with city.catalog.write() as session:
        lock_map(session, city.map_id).extractor = "efficientnet-lite0-vlad128"
    city.publish([(n, at(n)) for n in range(MIN_PHOTOS_TO_FIT)])
    assert not automatic(city), "the fit makes a generation that is evaluated anyway"
    with city.catalog.write() as session:
        lock_map(session, city.map_id).fitted_photos = MIN_PHOTOS_TO_FIT
    assert automatic(city)
