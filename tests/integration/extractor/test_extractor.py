"""The extractor on a real catalog, with real decoder processes: photos in, rows out."""

from __future__ import annotations

import gc
import json
import os
import threading
import time
from collections.abc import Callable
from typing import Any
from uuid import UUID

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from sqlalchemy import func, select
from sqlalchemy.exc import OperationalError

from services.extractor import publish as publish_module
from services.extractor import worker as worker_module
from services.extractor.generation_resolver import resolve_generation
from services.extractor.model_changes import ModelChangeRunner
from services.extractor.worker import ExtractorWorker
from services.steward.tasks.maintenance import release_expired_leases
from services.steward.tasks.model_changes import auto_fit_vocabularies
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.chunks import Chunk, Descriptor, list_live_chunks
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import WaitingFor
from shared.catalog.maps import Map
from shared.catalog.photos import Photo, mark_photo_deleted
from shared.descriptors.backbones.synthetic import TinyBackbone
from shared.descriptors.extractor import Extractor
from shared.descriptors.vocabulary import decode_centres
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import Pixels, get_preprocessing
from shared.jobs import Job, JobKind, JobState, claim_jobs
from shared.jobs.transitions import requeue_job
from shared.storage import FolderStore
from shared.storage.chunks import decode_rows, manifest_key
from shared.storage.keys import query_vector_key, thumbnail_key
from tests.integration.workplace import Workplace, expected_row, same
from tests.support.catalog_rows import end_pauses, expire_lease, set_columns, states
from tests.support.photos import encoded, photo_bytes, photo_image

Describe = Callable[..., NDArray[np.float32]]
DAY_SECONDS = 86_400.0


@pytest.fixture
def before_describing(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., None]], None]:
    """Has a function called with the pixels of each batch before its forward pass."""
    real: Describe = Extractor.describe

    def hook(do: Callable[..., None]) -> None:
        def describe(self: Extractor, pixels: list[Pixels], *made_with: Any) -> NDArray[np.float32]:
            do(pixels)
            return real(self, pixels, *made_with)

        monkeypatch.setattr(Extractor, "describe", describe)

    return hook


Hook = Callable[[Callable[..., None]], None]


def pixels_of(data: bytes) -> Pixels:
    return decode_photo(data, get_preprocessing("square32"), 10**9).pixels


def once(do: Callable[[], None]) -> Callable[..., None]:
    """Does it at the first call alone, also when the call leads to others."""
    calls = iter([do])

    def first(*_: Any) -> None:
        for act in calls:
            act()
            return

    return first


# --- describing ------------------------------------------------------------------------------


def test_each_photo_gets_its_one_row_and_the_right_one(averages: Workplace) -> None:
    photo_ids = averages.upload(*range(9))  # three batches
    result = averages.drain()
    assert (result.claimed, result.succeeded, result.failed) == (9, 9, 0)
    assert result.maps == {str(averages.map_id)}
    assert {"read", "decode", "describe", "publish"} <= result.seconds.keys()
    rows = averages.rows()
    assert set(rows) == set(photo_ids)
    for number, photo_id in enumerate(photo_ids):
        assert same(rows[photo_id], expected_row("test-tiny-avg", photo_bytes(number)))
        job = averages.job_of(photo_id)
        assert job.state == JobState.SUCCEEDED
        assert job.result == {
            "file_id": str(photo_id),
            "generation_id": str(averages.active().id),
        }
        assert averages.store.head(thumbnail_key(photo_id)) is not None
    with averages.catalog.read() as session:
        chunks = list_live_chunks(session, averages.active().id)
        assert [chunk.rows for chunk in chunks] == [4, 4, 1]
        # The first generation, then three batches: each is something new to find.
        assert session.get_one(Map, averages.map_id).version == 4
    for chunk in chunks:
        manifest = json.loads(averages.store.get(manifest_key(chunk.object_key)))
        assert manifest["sha256"] == chunk.sha256
        assert manifest["spec"] == averages.active().spec
    assert averages.drain().claimed == 0


def test_a_query_leaves_its_row_beside_its_bytes_and_none_in_the_map(averages: Workplace) -> None:
    averages.upload(1)
    averages.drain()
    data = photo_bytes(2)
    job_id = averages.ask(data)
    assert averages.drain().succeeded == 1
    reference = {
        "generation_id": str(averages.active().id),
        "object_key": query_vector_key(job_id),
        "row": 0,
    }
    assert averages.job(job_id).result == reference
    rows = decode_rows(averages.store.get(query_vector_key(job_id)))
    assert rows.shape == (1, 16)
    assert same(rows[0], expected_row("test-tiny-avg", data))
    assert len(averages.rows()) == 1


def test_a_query_comes_first_in_an_empty_map(averages: Workplace) -> None:
    job_id = averages.ask(photo_bytes(2))
    averages.drain()
    assert averages.job(job_id).state == JobState.SUCCEEDED
    assert averages.active().dimension == 16


def test_a_photo_that_is_at_fault_fails_alone(averages: Workplace) -> None:
    good = averages.upload(1, 2)
    _, undecodable = averages.upload_bytes(b"\xff\xd8\xff\xe0 this is no JPEG")
    lost_photo, lost = averages.upload_bytes(photo_bytes(4))
    query = averages.ask(photo_bytes(5)[:500])
    with averages.catalog.read() as session:
        averages.store.delete(session.get_one(Photo, lost_photo).object_key)
    result = averages.drain()
    assert (result.succeeded, result.failed) == (2, 3)
    assert set(averages.rows()) == set(good)
    for job_id, code in (
        (undecodable, "undecodable_photo"),
        (lost, "object_not_found"),
        (query, "undecodable_photo"),
    ):
        job = averages.job(job_id)
        assert (job.state, job.progress_failed) == (JobState.FAILED, 1)
        assert job.error is not None
        assert job.error["code"] == code
        assert job.error["detail"]


def test_two_workers_at_once_describe_each_photo_once(
    averages: Workplace, make_worker: Callable[[], ExtractorWorker]
) -> None:
    photo_ids = averages.upload(*range(16))
    workers = [make_worker(), make_worker()]
    threads = [threading.Thread(target=w.drain, args=[threading.Event()]) for w in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(averages.rows()) == set(photo_ids)
    with averages.catalog.read() as session:
        assert session.scalar(select(func.sum(Chunk.rows))) == 16
        assert session.scalar(select(func.count()).select_from(Generation)) == 1


def test_of_two_workers_that_begin_a_maps_first_generation_one_wins(
    averages: Workplace,
    make_worker: Callable[[], ExtractorWorker],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (other,) = averages.upload(1)
    first, second = make_worker(), make_worker()
    query = averages.ask(photo_bytes(2))
    # While the first one is about to make the generation, the second one does.
    real = Extractor.shipped_vocabulary
    meanwhile = once(lambda: _drain(second))

    def shipped(self: Extractor) -> Any:
        meanwhile()
        return real(self)

    monkeypatch.setattr(Extractor, "shipped_vocabulary", shipped)
    _drain(first)
    assert set(averages.rows()) == {other}
    assert averages.job(query).state == JobState.SUCCEEDED
    with averages.catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(Generation)) == 1


def _drain(worker: ExtractorWorker) -> None:
    worker.drain(threading.Event())


def test_photos_of_different_sizes_are_described_in_one_batch(
    workplace_of: Callable[[str], Workplace],
) -> None:
    extractor = "test-tiny-vlad:aggregator=gem,preprocessing=demo1024"
    place = workplace_of(extractor)
    sizes = [(64, 48), (48, 64), (1500, 900), (64, 48), (10, 10)]
    photos = [encoded(photo_image(n, *size), "PNG") for n, size in enumerate(sizes)]
    photo_ids = [place.upload_bytes(photo)[0] for photo in photos]
    result = place.drain()
    assert (result.claimed, result.succeeded, result.failed) == (5, 4, 1)
    rows = place.rows()
    for photo, photo_id in zip(photos[:4], photo_ids[:4], strict=True):
        assert same(rows[photo_id], expected_row(extractor, photo))
    too_small = place.job_of(photo_ids[4])
    assert too_small.error is not None
    assert too_small.error["code"] == "photo_too_small"
    spec = place.active().spec
    assert spec["preprocessing"] == {"name": "demo1024", "version": 1}
    assert (spec["aggregator"], spec["dimension"]) == ("gem", 16)


def test_vocabulary_is_fitted_on_photos_of_different_sizes(
    workplace_of: Callable[[str], Workplace],
) -> None:
    place = workplace_of("test-tiny-vlad:aggregator=soft-vlad,clusters=2,preprocessing=round14")
    for number, size in enumerate([(64, 48), (48, 64), (90, 90)]):
        place.upload_bytes(encoded(photo_image(number, *size), "PNG"))
    place.fit(clusters=2)
    generation = place.active()
    assert (generation.dimension, generation.spec["temperature"]) == (32, 1.0)
    assert len(place.rows()) == 3


# --- crashes ---------------------------------------------------------------------------------


def test_a_photo_that_crashes_the_forward_pass_fails_and_harms_no_other(
    averages: Workplace, before_describing: Hook
) -> None:
    poison = pixels_of(photo_bytes(2))
    batches: list[int] = []

    def crash(pixels: list[Pixels]) -> None:
        if any(np.array_equal(one, poison) for one in pixels):
            batches.append(len(pixels))
            raise RuntimeError("CUDA error: an illegal memory access was encountered")

    before_describing(crash)
    photo_ids = averages.upload(1, 2, 3)
    averages.drain()
    # Once with the others, then alone as often as a photo may.
    assert batches == [3] + [1] * averages.settings.max_attempts
    poisonous = averages.job_of(photo_ids[1])
    assert (poisonous.state, poisonous.attempts) == (JobState.FAILED, 3)
    assert poisonous.error is not None
    assert poisonous.error["code"] == "worker_fell"
    assert "RuntimeError" in poisonous.error["detail"]
    for photo_id in (photo_ids[0], photo_ids[2]):
        job = averages.job_of(photo_id)
        assert (job.state, job.alone, job.attempts) == (JobState.SUCCEEDED, True, 0)
    assert set(averages.rows()) == {photo_ids[0], photo_ids[2]}


def test_a_descriptor_that_is_not_finite_is_refused_and_harms_no_other(
    averages: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    poison = pixels_of(photo_bytes(2))
    real = TinyBackbone.features

    def overflow(self: TinyBackbone, pixels: torch.Tensor) -> torch.Tensor:
        features = real(self, pixels).clone()
        for photo, found in zip(pixels.numpy(), features, strict=True):
            if np.array_equal(photo, poison):
                found[3, 5] = np.inf  # one number of one patch
        return features

    monkeypatch.setattr(TinyBackbone, "features", overflow)
    photo_ids = averages.upload(1, 2, 3)
    result = averages.drain()
    assert (result.claimed, result.succeeded, result.failed) == (3, 2, 1)
    refused = averages.job_of(photo_ids[1])
    assert (refused.state, refused.attempts) == (JobState.FAILED, 0)
    assert refused.error is not None
    assert refused.error["code"] == "features_not_finite"
    rows = averages.rows()
    assert set(rows) == {photo_ids[0], photo_ids[2]}
    for number, photo_id in ((1, photo_ids[0]), (3, photo_ids[2])):
        assert same(rows[photo_id], expected_row("test-tiny-avg", photo_bytes(number)))


def test_a_crash_between_chunk_and_commit_leaves_an_orphan_that_is_collected(
    averages: Workplace,
    make_worker: Callable[[], ExtractorWorker],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Killed(BaseException):
        """Nothing in the worker may catch this, as nothing catches SIGKILL."""

    def die(*_: Any) -> None:
        raise Killed

    photo_ids = averages.upload(1, 2)
    with monkeypatch.context() as patched:
        patched.setattr(publish_module, "lock_map", die)
        with pytest.raises(Killed):
            averages.drain()
    orphans = averages.keys("chunks/")
    assert len(orphans) == 2  # rows and manifest
    assert averages.rows() == {}
    assert release_expired_leases(averages.catalog, 3) == 0  # the lease has to expire first
    expire_lease(averages.catalog, *(averages.job_of(p).id for p in photo_ids))
    assert release_expired_leases(averages.catalog, 3) == 2
    _drain(make_worker())
    assert set(averages.rows()) == set(photo_ids)
    live = averages.keys("")
    assert collect_orphans(averages.catalog, averages.store, DAY_SECONDS) == 0  # too young
    for key in live:
        _age(averages.store, key, 2 * DAY_SECONDS)
    assert collect_orphans(averages.catalog, averages.store, DAY_SECONDS) == 2
    assert averages.keys("") == live - orphans
    assert set(averages.rows()) == set(photo_ids)


def _age(store: FolderStore, key: str, seconds: float) -> None:
    then = time.time() - seconds
    os.utime(store.path(key), (then, then))


def test_a_stopping_worker_gives_back_what_it_took_ahead(
    averages: Workplace, before_describing: Hook
) -> None:
    stop = threading.Event()
    before_describing(lambda _: stop.set())
    photo_ids = averages.upload(*range(8))
    result = averages.worker.drain(stop)
    assert (result.claimed, result.succeeded) == (8, 4)
    ahead = [averages.job_of(photo_id) for photo_id in photo_ids[4:]]
    assert all(job.state == JobState.QUEUED and job.lease_token is None for job in ahead)
    assert all(job.attempts == 0 and not job.alone for job in ahead)


def test_no_lease_is_held_on_when_the_catalog_went_away_in_a_drain(
    averages: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo_ids = averages.upload(*range(8))
    calls = iter(range(10))

    def claim_or_fail(*arguments: Any, **options: Any) -> list[Job]:
        if next(calls) == 2:  # a batch is done, the next one is taken and being decoded
            raise OperationalError("the catalog is away", None, Exception())
        return claim_jobs(*arguments, **options)

    monkeypatch.setattr(worker_module, "claim_jobs", claim_or_fail)
    with pytest.raises(OperationalError):
        averages.drain()
    gc.collect()
    leases = [t.name for t in threading.enumerate() if t.name.startswith("lease-")]
    assert leases == []
    monkeypatch.undo()
    assert len(averages.rows()) == 4
    expire_lease(averages.catalog, *(averages.job_of(p).id for p in photo_ids[4:]))
    release_expired_leases(averages.catalog, 3)
    averages.drain()
    assert set(averages.rows()) == set(photo_ids)


# --- taken over, deleted, away ---------------------------------------------------------------


def test_nothing_of_a_batch_is_committed_once_its_lease_was_taken_over(
    averages: Workplace,
    make_worker: Callable[[], ExtractorWorker],
    before_describing: Hook,
) -> None:
    photo_ids = averages.upload(1, 2, 3)
    slow, quick = make_worker(), make_worker()
    seen: list[set[str]] = []

    def take_over() -> None:
        jobs = [averages.job_of(photo_id).id for photo_id in photo_ids]
        expire_lease(averages.catalog, *jobs)
        assert release_expired_leases(averages.catalog, 3) == 3
        _drain(quick)
        seen.append(averages.keys("chunks/"))

    before_describing(once(take_over))
    _drain(slow)
    assert set(averages.rows()) == set(photo_ids)
    with averages.catalog.read() as session:
        known = set(session.scalars(select(Chunk.object_key)))
        assert session.scalar(select(func.count()).select_from(Descriptor)) == 3
    assert known <= seen[0]  # all that the catalog knows was there before the slow one came
    assert averages.keys("chunks/") - seen[0]  # its chunk is an orphan
    assert {averages.job_of(photo_id).worker for photo_id in photo_ids} == {"worker-1"}


def test_one_job_that_was_taken_over_is_a_dead_row_beside_the_others(
    averages: Workplace, before_describing: Hook
) -> None:
    photo_ids = averages.upload(1, 2, 3)
    lost = averages.job_of(photo_ids[1]).id

    def start_anew() -> None:
        with averages.catalog.write() as session:
            requeue_job(session.get_one(Job, lost))

    before_describing(once(start_anew))
    averages.drain()
    rows = averages.rows()
    for number, photo_id in enumerate(photo_ids, start=1):
        assert same(rows[photo_id], expected_row("test-tiny-avg", photo_bytes(number)))
    with averages.catalog.read() as session:
        found = session.execute(
            select(Chunk.rows, func.count(Descriptor.photo_id))
            .join(Descriptor, Descriptor.chunk_id == Chunk.id)
            .group_by(Chunk.id, Chunk.rows)
            .order_by(Chunk.id)
        )
        assert [tuple(pair) for pair in found] == [(3, 2), (1, 1)]


def test_a_photo_deleted_while_it_is_described_is_not_in_the_generation(
    averages: Workplace, before_describing: Hook
) -> None:
    photo_ids = averages.upload(1, 2, 3)
    goes = averages.job_of(photo_ids[1]).id
    left = averages.job_of(photo_ids[2]).id

    def vanish() -> None:
        averages.delete(photo_ids[1])
        with averages.catalog.write() as session:  # without ending its job
            mark_photo_deleted(session, session.get_one(Photo, photo_ids[2]), 1)

    before_describing(once(vanish))
    assert averages.drain().succeeded == 1
    assert set(averages.rows()) == {photo_ids[0]}
    assert states(averages.catalog, [goes, left]) == [JobState.CANCELLED, JobState.CANCELLED]


def test_a_photo_deleted_before_it_is_read_costs_nothing(averages: Workplace) -> None:
    photo_ids = averages.upload(1, 2)
    job_id = averages.job_of(photo_ids[0]).id
    averages.delete(photo_ids[0])
    with averages.catalog.write() as session:  # the worker had claimed it just before
        requeue_job(session.get_one(Job, job_id))
    averages.drain()
    assert set(averages.rows()) == {photo_ids[1]}
    assert averages.job(job_id).state == JobState.CANCELLED


@pytest.mark.parametrize("failing", ["open", "writer"])
def test_jobs_pause_while_the_object_store_is_away_and_no_attempt_is_counted(
    averages: Workplace, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    photo_ids = averages.upload(1, 2)
    query = averages.ask(photo_bytes(3))
    jobs = [*(averages.job_of(photo_id).id for photo_id in photo_ids), query]

    def away(*_: Any) -> None:
        raise OSError("the disk is not there")

    for _ in range(averages.settings.max_attempts + 1):
        with monkeypatch.context() as patched:
            patched.setattr(FolderStore, failing, away)
            result = averages.drain()
        assert (result.claimed, result.succeeded, result.failed) == (3, 0, 0)
        for job_id in jobs:
            job = averages.job(job_id)
            assert (job.state, job.attempts, job.alone) == (JobState.QUEUED, 0, False)
            assert job.run_after is not None
        assert averages.drain().claimed == 0  # they pause
        end_pauses(averages.catalog)
    averages.drain()
    assert states(averages.catalog, jobs) == [JobState.SUCCEEDED] * 3
    assert set(averages.rows()) == set(photo_ids)


def test_photos_wait_for_a_worker_that_reproduces_the_generation(
    averages: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    averages.upload(1)
    averages.drain()
    real = Extractor.spec
    with monkeypatch.context() as patched:
        patched.setattr(
            Extractor, "spec", lambda self, *made_with: {**real(self, *made_with), "layer": "other"}
        )
        (photo_id,) = averages.upload(2)
        averages.drain()
    job = averages.job_of(photo_id)
    assert (job.state, job.attempts) == (JobState.QUEUED, 0)
    assert job.error is not None
    assert job.error["code"] == "spec_differs"
    end_pauses(averages.catalog)
    averages.drain()
    job = averages.job_of(photo_id)
    assert (job.state, job.error) == (JobState.SUCCEEDED, None)


# --- queries first ---------------------------------------------------------------------------


def test_a_query_waits_for_one_batch_at_most(averages: Workplace, before_describing: Hook) -> None:
    averages.upload(0)
    averages.drain()
    photo_ids = averages.upload(*range(1, 17))  # four batches
    asked: list[UUID] = []
    done_before: list[tuple[int, JobState]] = []

    def watch(pixels: list[Pixels]) -> None:
        if asked:
            done_before.append((len(pixels), JobState(averages.job(asked[0]).state)))
        else:  # in the first batch, when the second one is claimed and decoded already
            asked.append(averages.ask(photo_bytes(99)))

    before_describing(watch)
    averages.drain()
    assert done_before[0] == (1, JobState.RUNNING)  # the next forward pass is the query's
    assert done_before[1:] == [(4, JobState.SUCCEEDED)] * 3
    assert len(averages.rows()) == len(photo_ids) + 1


def test_a_query_does_not_even_wait_for_the_batch_that_is_being_described(
    averages: Workplace, before_describing: Hook
) -> None:
    averages.upload(0)
    averages.drain()
    averages.upload(*range(1, 5))
    answered: list[JobState] = []

    def ask_and_wait(pixels: list[Pixels]) -> None:
        if len(pixels) > 1:  # the bulk batch, which goes on only when the query is answered
            job_id = averages.ask(photo_bytes(99))
            answered.append(averages.await_end(job_id))

    before_describing(ask_and_wait)
    averages.drain()
    assert answered == [JobState.SUCCEEDED]
    assert len(averages.rows()) == 5


def test_nothing_is_described_beside_a_photo_that_is_tried_alone(
    averages: Workplace, before_describing: Hook
) -> None:
    photo_id, job_id = averages.upload_bytes(photo_bytes(0))
    set_columns(averages.catalog, job_id, alone=True)
    during: list[JobState] = []
    asked: list[UUID] = []

    def ask(_: NDArray[np.uint8]) -> None:
        if not asked:
            asked.append(averages.ask(photo_bytes(99)))
            time.sleep(3 * worker_module.QUERY_POLL_SECONDS)
            during.append(JobState(averages.job(asked[0]).state))

    before_describing(ask)
    averages.drain()
    assert during == [JobState.QUEUED]
    assert averages.job(asked[0]).state == JobState.SUCCEEDED
    assert set(averages.rows()) == {photo_id}


def test_a_query_goes_between_the_slices_of_a_fit(
    vlads: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    vlads.upload(*range(8))
    vlads.fit()
    job_id = vlads.start(JobKind.FIT, clusters=8, sample=100, seed=1)
    asked: list[UUID] = []
    stages: list[tuple[str | None, JobState]] = []
    real = ModelChangeRunner.run_step

    def watch(self: ModelChangeRunner, job: Job) -> None:
        if asked:
            stages.append((job.stage, JobState(vlads.job(asked[-1]).state)))
        asked.append(vlads.ask(photo_bytes(50 + len(asked))))
        real(self, job)

    monkeypatch.setattr(ModelChangeRunner, "run_step", watch)
    vlads.drain()
    assert [stage for stage, _ in stages] == ["sample", "sample", "cluster"]
    assert {state for _, state in stages} == {JobState.SUCCEEDED}
    assert vlads.job(job_id).waiting_for == WaitingFor.DESCRIPTORS


# --- without a vocabulary --------------------------------------------------------------------


def test_photos_wait_for_a_vocabulary_which_is_fitted_once_there_are_enough(
    vlads: Workplace,
) -> None:
    photo_ids = vlads.upload(1, 2, 3)
    query = vlads.ask(photo_bytes(9))
    vlads.drain()
    for photo_id in photo_ids:
        job = vlads.job_of(photo_id)
        assert (job.state, job.waiting_for) == (JobState.QUEUED, WaitingFor.VOCABULARY)
        assert job.attempts == 0
    refused = vlads.job(query)
    assert refused.state == JobState.FAILED
    assert refused.error is not None
    assert refused.error["code"] == "no_vocabulary"

    auto_fit_vocabularies(vlads.catalog, vlads.hints, 4)  # AUTO_FIT_PHOTOS
    assert not vlads.hints.wait(0)
    photo_ids += vlads.upload(4)
    vlads.drain()
    auto_fit_vocabularies(vlads.catalog, vlads.hints, 4)
    assert vlads.hints.wait(0)
    auto_fit_vocabularies(vlads.catalog, vlads.hints, 4)  # once is enough
    with vlads.catalog.read() as session:
        job_id = session.scalars(select(Job.id).where(Job.kind == JobKind.FIT)).one()
    fit = vlads.finish(job_id)
    assert fit.state == JobState.SUCCEEDED
    assert fit.result is not None
    assert (fit.result["photos"], fit.result["failed"]) == (4, 0)
    generation = vlads.active()
    vocabulary = vlads.vocabulary(generation.vocabulary_id)
    centres = decode_centres(vlads.store.get(vocabulary.object_key))
    rows = vlads.rows()
    assert set(rows) == set(photo_ids)
    for number, photo_id in enumerate(photo_ids, start=1):
        assert same(rows[photo_id], expected_row("test-tiny-vlad", photo_bytes(number), centres))
        assert vlads.job_of(photo_id).state == JobState.SUCCEEDED
    query = vlads.ask(photo_bytes(9))
    vlads.drain()
    assert vlads.job(query).state == JobState.SUCCEEDED


def test_no_vocabulary_is_fitted_by_itself_after_a_fit_was_cancelled(vlads: Workplace) -> None:
    vlads.upload(1, 2)
    vlads.drain()
    vlads.cancel(vlads.start(JobKind.FIT, clusters=8, sample=100, seed=0))
    auto_fit_vocabularies(vlads.catalog, vlads.hints, 1)
    with vlads.catalog.read() as session:
        assert session.scalar(select(func.count()).where(Job.kind == JobKind.FIT)) == 1


def test_a_photo_that_finds_no_vocabulary_while_one_is_made_is_not_left_waiting(
    vlads: Workplace,
    make_worker: Callable[[], ExtractorWorker],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vlads.upload(1, 2)
    slow, quick = make_worker(), make_worker()
    late: list[UUID] = []

    def find_or_fit(*arguments: Any) -> Any:
        found = resolve_generation(*arguments)
        if late and found is None and vlads.job_of(late[0]).worker == "worker-0":
            fit()
        return found

    fit = once(lambda: _fit_with(vlads, quick))
    _drain(slow)
    late += vlads.upload(3)
    monkeypatch.setattr(worker_module, "resolve_generation", find_or_fit)
    _drain(slow)  # sees no vocabulary; before it says so, the other worker has fitted one
    assert vlads.job_of(late[0]).state == JobState.SUCCEEDED
    assert set(vlads.rows()) >= set(late)


def _fit_with(workplace: Workplace, worker: ExtractorWorker) -> None:
    workplace.start(JobKind.FIT, clusters=8, sample=100, seed=0)
    _drain(worker)
    assert workplace.active().state == GenerationState.ACTIVE
