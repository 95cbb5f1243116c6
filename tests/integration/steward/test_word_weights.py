"""Word weights on a live map: fitted, tested on held-out photos, used or not."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from numpy.typing import NDArray

from services.search.worker import SearchWorker
from services.steward import word_weights as word_weights_module
from services.steward.evaluation_worker import EvaluationWorker
from services.steward.tasks import auto_evaluation
from services.steward.tasks.auto_evaluation import evaluate_changed_maps
from services.steward.tasks.compaction import merge_slot
from services.steward.tasks.garbage_collection import collect_superseded_chunks
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import get_map
from shared.catalog.vocabularies import VocabularyOrigin, add_vocabulary
from shared.config.settings import Settings
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState, Priority
from shared.storage import ObjectStore
from shared.word_weights.record import Outcome, WordWeights, parse_word_weights
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_chunk, add_generation, add_photo, failure_code, read_job
from tests.support.problems import problem

pytestmark = pytest.mark.numerics

WORDS, WIDTH = 4, 8
TRIED = 60  # photos
FEW = 5  # of them, where nothing depends on what they show
DEGREES_PER_M = math.degrees(1 / 6_371_008.8)
Rows = NDArray[np.float32]


def rows_of_places(places: int, views: int, reported: bool, seed: int = 0) -> Rows:
    """VLAD-like rows, place by place. Two words are noise from photo to photo. With `reported` the
    others show the place, faintly; else nothing does."""
    rng = np.random.default_rng(seed)
    own = np.repeat(rng.standard_normal((places, 2, WIDTH)), views, axis=0)
    noise = rng.standard_normal((places * views, WORDS, WIDTH))
    rows = noise.copy()
    if reported:
        rows[:, :2] = own + 0.8 * noise[:, :2]
        rows[:, 2:] *= 2.0
    rows = rows.reshape(len(rows), -1)
    found: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return found


@dataclass(slots=True)
class City:
    """A map with a vocabulary of its own, whose rows are laid out by hand."""

    catalog: Catalog
    store: ObjectStore
    map_id: UUID
    generation_id: UUID
    photos: list[UUID]

    def publish(self, rows: Rows, spots: list[dict[str, Any]]) -> None:
        with self.catalog.write() as session:
            photo_ids = [add_photo(session, self.map_id, **columns).id for columns in spots]
        add_chunk(self.catalog, self.store, self.generation_id, photo_ids, rows=rows)
        self.photos += photo_ids

    def work(self) -> bool:
        search = SearchWorker(self.catalog, self.store, Settings())
        evaluator = EvaluationWorker(self.catalog, self.store, search, Settings(), "evaluator")
        return evaluator.run_next(threading.Event())

    def start(self, **params: Any) -> UUID:
        fields = {"sample": TRIED, "seed": 0, "generation_id": str(self.generation_id)}
        with self.catalog.write() as session:
            job = Job(
                id=new_id(),
                map_id=self.map_id,
                kind=JobKind.WORD_WEIGHTS,
                priority=Priority.EVALUATION,
                params={**fields, **params},
            )
            session.add(job)
        return job.id

    def learn(self, **params: Any) -> WordWeights:
        job_id = self.start(**params)
        assert self.work()
        job = read_job(self.catalog, job_id)
        assert job.state == JobState.SUCCEEDED, job.error
        record = self.record()
        assert record is not None
        assert job.result is not None
        assert job.result["outcome"] == record.outcome
        return record

    def record(self) -> WordWeights | None:
        with self.catalog.read() as session:
            return parse_word_weights(session.get_one(Generation, self.generation_id).word_weights)

    def set_generation(self, **columns: Any) -> None:
        with self.catalog.write() as session:
            generation = session.get_one(Generation, self.generation_id)
            for name, value in columns.items():
                setattr(generation, name, value)


@pytest.fixture
def city(service: Service) -> City:
    with service.catalog.write() as session:
        map_id = get_map(session, "default").id
        vocabulary = add_vocabulary(
            session,
            map_id,
            VocabularyOrigin.FITTED,
            shape=(WORDS, WIDTH),
            object_key=f"vocabularies/{uuid4()}.npy",
            sha256="0" * 64,
            provenance={},
        )
        generation = add_generation(session, map_id, dimension=WORDS * WIDTH)
        generation.vocabulary_id = vocabulary.id
        generation.spec = {"preprocessing": {"name": "square224"}, "clusters": WORDS}
    return City(service.catalog, service.store, map_id, generation.id, [])


def street(places: int, views: int = 3) -> list[dict[str, Any]]:
    """Places 200 m apart; the views of each 6 m apart."""
    return [
        {"latitude": (200 * place + 6 * view) * DEGREES_PER_M, "longitude": 7.0}
        for place in range(places)
        for view in range(views)
    ]


def rooms(places: int, views: int = 3) -> list[dict[str, Any]]:
    return [{"place": f"room {place}"} for place in range(places) for _ in range(views)]


# --- fitted, and used or not ------------------------------------------------------------------


@pytest.mark.parametrize("spots", [street, rooms])
def test_words_that_distinguish_places_are_weighted(city: City, spots: Any) -> None:
    city.publish(rows_of_places(40, 3, reported=True), spots(40))
    record = city.learn()
    assert record.outcome == Outcome.KEPT
    assert record.taught_by == ("coordinates" if spots is street else "places")
    assert len(record.weights) == WORDS
    assert min(record.weights[:2]) > 2 * max(record.weights[2:])
    held_out = record.held_out
    assert held_out is not None
    assert held_out.without["queries"] == held_out.weighted["queries"] == TRIED
    assert held_out.weighted["R@1"] > held_out.without["R@1"]
    assert held_out.better - held_out.worse == round(
        TRIED * (held_out.weighted["R@1"] - held_out.without["R@1"])
    )
    assert held_out.chance < 0.05
    assert record.calibration is not None
    assert record.calibration.in_map_limit is not None
    assert record.near_pairs >= 100
    assert record.seed == 0


def test_weights_that_raise_nothing_are_not_kept(city: City) -> None:
    city.publish(rows_of_places(40, 3, reported=False), street(40))
    record = city.learn()
    assert (record.outcome, record.applied, record.calibration) == (Outcome.NOT_KEPT, (), None)
    assert len(record.weights) == WORDS
    assert record.held_out is not None


def test_too_few_pairs_are_no_error_and_are_reported_in_numbers(city: City) -> None:
    city.publish(rows_of_places(8, 3, reported=True), street(8))
    record = city.learn()
    assert (record.outcome, record.weights) == (Outcome.NOT_ENOUGH_PAIRS, ())
    assert record.near_pairs == 24
    assert "12 and 12 pairs" in record.reason
    assert "each half needs 50 pairs" in record.reason


def test_a_burst_is_left_out_with_the_photo_that_is_tried(city: City) -> None:
    """Each place is a burst of three within 2 m, and three more 10 m on. A photo's burst is its
    twin: it would be found first in any case."""
    rows = rows_of_places(40, 2, reported=True)
    spots = [
        {"latitude": (200 * place + 10 * view + twin) * DEGREES_PER_M, "longitude": 7.0}
        for place in range(40)
        for view in range(2)
        for twin in range(3)
    ]
    city.publish(np.repeat(rows, 3, axis=0), spots)
    record = city.learn()
    assert record.held_out is not None
    assert record.held_out.without["queries"] == TRIED
    assert record.held_out.without["R@1"] < 0.9, "a twin was found"
    assert record.outcome == Outcome.KEPT


def test_the_same_seed_learns_the_same_however_little_memory_there_is(
    city: City, monkeypatch: pytest.MonkeyPatch
) -> None:
    for part in range(3):
        city.publish(rows_of_places(40, 3, reported=True)[part::3], [*street(40)][part::3])
    first, again, other = (city.learn(seed=seed, sample=FEW) for seed in (0, 0, 1))
    assert first == again
    assert first.weights != other.weights
    monkeypatch.setattr(word_weights_module, "ROW_BATCH_BYTES", 10 * WORDS * WIDTH * 4)
    small = city.learn(sample=FEW)
    assert small.near_pairs == first.near_pairs
    assert min(small.weights[:2]) > 2 * max(small.weights[2:])


def test_chunks_merged_and_photos_deleted_since_change_no_row_of_another(city: City) -> None:
    rows, spots = rows_of_places(40, 3, reported=True), street(40)
    for begin in range(0, 120, 30):
        city.publish(rows[begin : begin + 30], spots[begin : begin + 30])
    before = city.learn(sample=FEW)
    assert merge_slot(city.catalog, city.store, city.generation_id, 0)
    collect_superseded_chunks(city.catalog, city.store, grace_seconds=0)
    assert city.learn(sample=FEW).weights == before.weights


def test_rows_that_can_not_be_read_end_the_learning_and_keep_nothing(city: City) -> None:
    city.publish(rows_of_places(40, 3, reported=True), street(40))
    key = next(i.key for i in city.store.list("chunks/") if i.key.endswith(".npy"))
    city.store.put(key, city.store.get(key)[:-200])
    job_id = city.start()
    assert city.work()
    assert failure_code(read_job(city.catalog, job_id)) == "map_damaged"
    assert city.record() is None


@pytest.mark.parametrize("name", ["demo1024", "paper480x640", "round14"])
def test_generations_that_reproduce_published_figures_get_none(city: City, name: str) -> None:
    city.set_generation(spec={"preprocessing": {"name": name}})
    assert _refused(city) == "no_word_weights"


def test_generations_without_words_get_none(city: City) -> None:
    city.set_generation(dimension=WORDS * WIDTH - 1)  # projected by PCA
    assert _refused(city) == "no_word_weights"
    city.set_generation(vocabulary_id=None)
    assert _refused(city) == "no_word_weights"


def _refused(city: City) -> str:
    job_id = city.start()
    assert city.work()
    return failure_code(read_job(city.catalog, job_id))


# --- by themselves ---------------------------------------------------------------------------


@pytest.fixture
def small_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(auto_evaluation, "AUTO_SAMPLE_PHOTOS", TRIED)


def queued(city: City) -> str | None:
    """The kind of job that the steward queues now; it is done at once."""
    evaluate_changed_maps(city.catalog, Settings())
    with city.catalog.read() as session:
        job = session.query(Job).filter(Job.state == JobState.QUEUED).one_or_none()
    if job is None:
        return None
    assert city.work()
    assert read_job(city.catalog, job.id).state == JobState.SUCCEEDED
    return job.kind


@pytest.mark.usefixtures("small_samples")
def test_weights_are_learnt_by_themselves_after_the_evaluation_and_when_the_map_has_grown(
    city: City,
) -> None:
    city.publish(rows_of_places(40, 3, reported=True), street(40))
    assert queued(city) == JobKind.EVALUATE
    assert queued(city) == JobKind.WORD_WEIGHTS
    assert queued(city) is None
    more = [{**spot, "longitude": 8.0} for spot in street(20)]
    city.publish(rows_of_places(20, 3, reported=True, seed=1), more)
    assert queued(city) == JobKind.EVALUATE
    before = city.record()
    assert queued(city) == JobKind.WORD_WEIGHTS
    assert queued(city) is None
    after = city.record()
    assert before is not None
    assert after is not None
    assert (before.searchable, after.searchable) == (120, 180)


@pytest.mark.usefixtures("small_samples")
def test_a_foreign_vocabulary_is_not_weighed_by_itself(city: City, service: Service) -> None:
    city.publish(rows_of_places(40, 3, reported=True), street(40))
    with service.catalog.write() as session:
        foreign = add_vocabulary(
            session,
            city.map_id,
            VocabularyOrigin.SHIPPED,
            shape=(WORDS, WIDTH),
            object_key="vocabularies/shipped.npy",
            sha256="1" * 64,
            provenance={},
        )
    city.set_generation(vocabulary_id=foreign.id)
    assert queued(city) == JobKind.EVALUATE
    assert queued(city) is None


@pytest.mark.usefixtures("small_samples")
@pytest.mark.databases("sqlite", "postgresql")
def test_an_evaluation_measures_both_rankings_and_renews_what_their_scores_mean(
    city: City,
) -> None:
    city.publish(rows_of_places(40, 3, reported=True), street(40))
    record = city.learn()
    assert queued(city) == JobKind.EVALUATE
    with city.catalog.read() as session:
        job = session.query(Job).filter(Job.kind == JobKind.EVALUATE).one()
        plain = session.get_one(Generation, city.generation_id).calibration
    assert job.result is not None
    weighted = job.result["with_word_weights"]
    assert weighted["leave_one_out"]["R@1"] > job.result["leave_one_out"]["R@1"]
    renewed = city.record()
    assert renewed is not None
    assert renewed.calibration is not None
    assert renewed.weights == record.weights
    assert plain is not None
    assert renewed.calibration.in_map_limit != plain["in_map_limit"]


# --- over HTTP -------------------------------------------------------------------------------


def test_answers_rank_by_the_weights_and_say_so(city: City, service: Service) -> None:
    city.publish(rows_of_places(40, 3, reported=True), street(40))
    path = f"/similarity/{city.photos[7]}"
    before = service.json("POST", path, params={"top_k": 20})
    assert before["word_weights"] == "none"
    assert {image["weighted_score"] for image in before["similar_images"]} == {None}

    started = service.json("POST", f"/generations/{city.generation_id}/word-weights", 202, json={})
    assert city.work()
    assert service.json("GET", f"/jobs/{started['job_id']}")["result"]["outcome"] == "kept"
    body = service.json("GET", f"/generations/{city.generation_id}/word-weights")
    assert (body["outcome"], len(body["weights"])) == ("kept", WORDS)

    weighted = service.json("POST", path, params={"top_k": 20})
    assert weighted["word_weights"] == "applied"
    by_weight = [image["weighted_score"] for image in weighted["similar_images"]]
    plain = {i["image_id"]: i["similarity_score"] for i in before["similar_images"]}
    assert by_weight == sorted(by_weight, reverse=True)
    assert [i["image_id"] for i in weighted["similar_images"]] != list(plain)
    for image in weighted["similar_images"]:
        if image["image_id"] in plain:
            assert image["similarity_score"] == pytest.approx(plain[image["image_id"]])

    off = service.json("POST", path, params={"top_k": 20, "word_weights": False})
    assert off["word_weights"] == "off"
    assert off["similar_images"] == before["similar_images"]


def test_the_least_score_is_of_the_plain_cosine_and_fills_up_the_answer(
    city: City, service: Service
) -> None:
    city.publish(rows_of_places(40, 3, reported=True), street(40))
    city.learn()
    path = f"/similarity/{city.photos[7]}"
    off = service.json("POST", path, params={"top_k": 40, "word_weights": False})
    least = off["similar_images"][-1]["similarity_score"]
    found = service.json("POST", path, params={"top_k": 40, "min_score": least})
    assert {i["image_id"] for i in found["similar_images"]} == {
        i["image_id"] for i in off["similar_images"]
    }
    by_weight = [image["weighted_score"] for image in found["similar_images"]]
    assert by_weight == sorted(by_weight, reverse=True)


def test_the_estimate_is_judged_by_what_its_own_ranking_has_taught(
    city: City, service: Service
) -> None:
    city.publish(rows_of_places(40, 3, reported=True), street(40))
    record = city.learn()
    assert record.calibration is not None
    limit = f"below {record.calibration.in_map_limit:.4f}"
    path = f"/similarity/{city.photos[7]}"
    assert limit in service.json("POST", path)["estimate"]["reason"]
    off = service.json("POST", path, params={"word_weights": False})["estimate"]
    assert off["in_map"] is None, "no evaluation has seen the plain ranking yet"


def test_what_can_not_be_learnt_is_refused_with_a_reason(city: City, service: Service) -> None:
    path = f"/generations/{city.generation_id}/word-weights"
    problem(service("POST", path), 409, "nothing_to_evaluate")
    problem(service("GET", path), 404, "word_weights_not_found")
    problem(service("POST", f"/generations/{uuid4()}/word-weights"), 404, "generation_not_found")
    problem(service("POST", "/generations/nonsense/word-weights"), 404, "generation_not_found")
    city.set_generation(spec={"preprocessing": {"name": "paper480x640"}})
    assert "paper480x640" in problem(service("POST", path), 409, "no_word_weights")["detail"]
    city.set_generation(state=GenerationState.RETIRED)
    problem(service("POST", path), 409, "generation_not_active")
