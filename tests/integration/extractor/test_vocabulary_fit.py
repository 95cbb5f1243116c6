"""Model changes that fit a vocabulary, and what happens in the map meanwhile."""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Callable
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from services.extractor import fits
from services.extractor.child_process import ChildKilled
from services.extractor.fits import FIT_PROGRESS_UNITS
from services.extractor.worker import ExtractorWorker
from services.steward.tasks import model_changes, reindex_jobs
from services.steward.tasks.garbage_collection import collect_garbage
from services.steward.tasks.model_changes import advance_model_changes
from services.steward.tasks.reindex_jobs import delete_done_reindex_jobs
from shared.catalog.chunks import list_live_chunks, select_failed_photos
from shared.catalog.generations import GenerationState
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.descriptors.extractor import Extractor
from shared.descriptors.vocabulary import decode_centres
from shared.integrity.verify import discard_chunk
from shared.jobs import Job, JobKind, JobState, progress
from shared.jobs.progress import JobProgress
from shared.jobs.runner import MAX_ATTEMPTS
from shared.jobs.transitions import cancel_job, requeue_job_as_new, retry_job
from tests.integration.extractor.model_changes import (
    PHOTOS,
    WIDTH,
    import_file,
    npy,
    photo_ids,
    some_centres,
)
from tests.integration.harness import FIT, Harness, expected_row, same
from tests.support.catalog_rows import failure_code, problem_of, result_of
from tests.support.photos import photo_bytes

pytestmark = pytest.mark.numerics


def test_a_fit_replaces_the_generation_while_the_old_one_answers(fitted: Harness) -> None:
    old, before = fitted.active(), fitted.rows()
    version = _version(fitted)
    job_id = fitted.start(JobKind.FIT, **{**FIT, "seed": 1})
    answering: list[tuple[UUID, int]] = []

    job = fitted.finish(job_id, lambda: answering.append((fitted.active().id, fitted.searchable())))

    new = fitted.active()
    assert new.id != old.id
    assert {count for _, count in answering} == {PHOTOS}  # at no moment fewer
    assert [generation for generation, _ in itertools.groupby(a for a, _ in answering)] == [
        old.id,
        new.id,
    ]
    retired = fitted.generation(old.id)
    assert (retired.state, new.state) == (GenerationState.RETIRED, GenerationState.ACTIVE)
    assert retired.ended_at is not None
    assert new.activated_at is not None
    assert fitted.building() is None
    assert job.result == {
        "generation_id": str(new.id),
        "vocabulary_id": str(new.vocabulary_id),
        "clusters": 7,  # 6 photos of 64 patches, 50 for each
        "dimension": 7 * WIDTH,
        "pca": None,
        "photos": PHOTOS,
        "failed": 0,
    }
    assert job.progress_done == job.progress_total == 2 * PHOTOS + FIT_PROGRESS_UNITS
    assert _version(fitted) > version

    vocabulary = fitted.vocabulary(new.vocabulary_id)
    assert (vocabulary.origin, vocabulary.standing) == ("fitted", "provisional")
    centres = decode_centres(fitted.store.get(vocabulary.object_key))
    assert vocabulary.sha256 == centres.sha256 == new.spec["vocabulary_sha256"]
    rows = fitted.rows()
    for number, photo_id in enumerate(photo_ids(fitted)):
        expected = expected_row("test-tiny-vlad", photo_bytes(number), centres)
        assert same(rows[photo_id], expected)
        assert not same(before[photo_id], expected)
        assert fitted.job_of(photo_id).state == JobState.SUCCEEDED
    delete_done_reindex_jobs(fitted.catalog)
    assert fitted.reindex_jobs(new.id) == []


def _version(harness: Harness) -> int:
    with harness.catalog.read() as session:
        return session.get_one(Map, harness.map_id).version


def test_a_fit_that_names_no_number_makes_as_many_clusters_as_the_extractors_name_says(
    harness_of: Callable[[str], Harness],
) -> None:
    harness = harness_of("test-tiny-vlad:clusters=2")
    harness.upload(1, 2, 3)
    job = harness.fit(clusters=None)
    assert job.state == JobState.SUCCEEDED
    generation = harness.active()
    assert (generation.extractor, generation.spec["clusters"]) == ("test-tiny-vlad:clusters=2", 2)
    assert harness.vocabulary(generation.vocabulary_id).provenance["clusters_asked"] == 2
    assert harness.fit(clusters=3, seed=1).result is not None
    assert harness.active().spec["clusters"] == 3, "what a fit says goes before the name"


def test_a_fit_without_photos_that_can_be_decoded_fails_with_the_reason(vlads: Harness) -> None:
    assert failure_code(vlads.fit()) == "no_photos"
    vlads.upload_bytes(b"nothing")
    assert failure_code(vlads.fit()) == "no_photos"


def test_an_extractor_without_vocabulary_has_nothing_to_fit_or_import(averages: Harness) -> None:
    averages.upload(1)
    averages.drain()
    generation = averages.active().id
    for job in (averages.fit(), averages.finish(import_file(averages, npy(some_centres(3))))):
        assert failure_code(job) == "vocabulary_unusable"
    assert averages.active().id == generation


def test_a_fit_that_is_computed_in_a_child_process_gives_the_same_vocabulary(
    fitted: Harness,
    harness_of: Callable[[str], Harness],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The child opens the catalog and the store of the settings itself."""
    with_child = harness_of("test-tiny-vlad")
    with_child.upload(*range(PHOTOS))
    reported: list[tuple[str | None, int]] = []
    real = JobProgress.update

    def update(self: JobProgress, *news: Any) -> None:
        real(self, *news)
        job = with_child.job(job_id)
        reported.append((job.stage, job.progress_done))

    settings = with_child.settings.model_copy(
        update={
            "database_url": with_child.catalog.url.render_as_string(hide_password=False),
            "upload_dir": with_child.store.root,
            "device": "cpu",
        }
    )
    monkeypatch.setattr(progress, "PROGRESS_SECONDS", 0.0)
    monkeypatch.setattr(JobProgress, "update", update)
    job_id = with_child.start(JobKind.FIT, **FIT)
    worker = ExtractorWorker(with_child.catalog, with_child.store, settings, "with a child")
    with contextlib.closing(worker):
        assert worker.fits.run_next(threading.Event())
    total = with_child.job(job_id).progress_total
    with_child.finish(job_id)
    ours, expected = (
        decode_centres(
            harness.store.get(harness.vocabulary(harness.active().vocabulary_id).object_key)
        )
        for harness in (with_child, fitted)
    )
    # The child has other threads, which sum in another order.
    np.testing.assert_allclose(ours.array, expected.array, atol=1e-3)
    stages, done = zip(*reported, strict=True)
    assert [stage for stage, _ in itertools.groupby(stages)] == ["sample", "cluster"]
    assert list(done) == sorted(done)
    assert (done[-1], total) == (PHOTOS + FIT_PROGRESS_UNITS, 2 * PHOTOS + FIT_PROGRESS_UNITS)


def test_a_fit_whose_process_is_killed_is_tried_again_and_then_fails(
    fitted: Harness, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    old = fitted.active().id
    deaths = itertools.count(1)

    def die(*_: Any) -> None:
        next(deaths)
        raise ChildKilled("its process was killed (SIGKILL)")

    job_id = fitted.start(JobKind.FIT, **FIT)
    monkeypatch.setattr(fits, "compute_fit", die)
    fitted.drain()
    job = fitted.job(job_id)
    assert job.state == JobState.FAILED
    assert next(deaths) == MAX_ATTEMPTS + 1
    assert problem_of(job)["code"] == "worker_crashed"
    assert "its process was killed (SIGKILL)" in caplog.text
    monkeypatch.undo()
    assert fitted.active().id == old


def test_photos_that_arrive_meanwhile_are_in_both_generations(fitted: Harness) -> None:
    old = fitted.active().id
    job_id, new = fitted.build(seed=1)
    fitted.advance()  # reindex jobs for what is there now
    late = fitted.upload(101, 102)
    fitted.drain()
    assert set(late) <= fitted.rows(old).keys()  # searchable at once
    assert not set(late) & fitted.rows(new).keys()
    fitted.advance()
    fitted.drain()
    assert fitted.active().id == old
    assert set(late) <= fitted.rows(new).keys()
    fitted.advance()
    assert fitted.active().id == new
    assert fitted.job(job_id).state == JobState.SUCCEEDED
    assert set(fitted.rows(new)) == set(photo_ids(fitted))


def test_a_photo_that_is_being_described_at_the_switch_ends_up_in_the_new_generation(
    fitted: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = fitted.active().id
    job_id, new = fitted.build(seed=1)
    fitted.advance()
    fitted.drain()  # complete, not switched yet
    (late,) = fitted.upload(101)
    real = Extractor.describe
    switched: list[UUID] = []

    def describe(self: Extractor, *arguments: Any) -> Any:
        if not switched:
            fitted.advance()
            switched.append(fitted.active().id)
        return real(self, *arguments)

    monkeypatch.setattr(Extractor, "describe", describe)
    fitted.drain()
    assert switched == [new]
    assert fitted.job(job_id).state == JobState.SUCCEEDED
    assert late not in fitted.rows(old)
    assert late in fitted.rows(new)
    assert fitted.job_of(late).state == JobState.SUCCEEDED
    assert fitted.job_of(late).attempts == 0


def test_each_run_queues_another_chunk_however_little_time_it_has(
    fitted: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reindex_jobs, "SLICE_SECONDS", -1.0)
    fitted.upload(101)
    fitted.drain()
    with fitted.catalog.read() as session:
        chunks = len(list_live_chunks(session, fitted.active().id))
    assert chunks > 1
    job_id, new = fitted.build(seed=1)
    queued = []
    for _ in range(1 + chunks):  # first those whose description failed before
        fitted.advance()
        queued.append(len(fitted.reindex_jobs(new)))
    assert sorted(set(queued)) == queued, "each run queues more"
    assert queued[-1] == PHOTOS + 1
    assert fitted.finish(job_id).state == JobState.SUCCEEDED


def test_a_model_change_does_not_wait_for_deleted_photos(fitted: Harness) -> None:
    job_id, new = fitted.build(seed=1)
    before, after, *rest = photo_ids(fitted)
    fitted.delete(before)  # before it was queued for the new generation
    fitted.advance()
    fitted.delete(after)  # queued, not described
    fitted.drain()
    fitted.delete(rest[0])  # described
    fitted.advance()
    result = result_of(fitted.job(job_id))
    assert (result["photos"], result["failed"]) == (PHOTOS - 3, 0)
    assert fitted.active().id == new
    assert set(fitted.rows(new)) == set(rest)


def test_all_photos_deleted_meanwhile_leave_an_empty_generation(fitted: Harness) -> None:
    job_id, new = fitted.build(seed=1)
    fitted.advance()
    for photo_id in photo_ids(fitted):
        fitted.delete(photo_id)
    assert fitted.finish(job_id).state == JobState.SUCCEEDED
    assert fitted.active().id == new
    assert fitted.searchable() == 0


def spoil(harness: Harness, photo_id: UUID) -> None:
    """Replace the photo's stored bytes by others that are no photo."""
    with harness.catalog.read() as session:
        key = session.get_one(Photo, photo_id).object_key
    harness.store.put(key, b"the disk has rotted")


def test_a_photo_that_fails_in_the_new_generation_is_recorded_and_blocks_nothing(
    fitted: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(model_changes, "MAX_LOST_SHARE", 1 / PHOTOS)
    job_id, new = fitted.build(seed=1)
    bad, *good = photo_ids(fitted)
    spoil(fitted, bad)
    job = fitted.finish(job_id)
    result = result_of(job)
    assert (result["photos"], result["failed"]) == (PHOTOS - 1, 1)
    assert (job.progress_failed, job.progress_done) == (1, job.progress_total - 1)
    assert fitted.active().id == new
    assert set(fitted.rows()) == set(good)
    delete_done_reindex_jobs(fitted.catalog)
    (failed,) = fitted.reindex_jobs(new)
    assert (failed.state, failed.photo_id) == (JobState.FAILED, bad)
    assert problem_of(failed)["code"] == "undecodable_photo"
    assert fitted.job_of(bad).id == failed.id  # the photo says so itself
    assert all(fitted.job_of(photo_id).state == JobState.SUCCEEDED for photo_id in good)


@pytest.mark.parametrize("later_changes", [0, 1])
def test_a_photo_that_failed_in_a_generation_is_described_when_it_is_queued_again(
    fitted: Harness, later_changes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(model_changes, "MAX_LOST_SHARE", 1 / PHOTOS)
    bad = photo_ids(fitted)[0]
    with fitted.catalog.read() as session:
        key = session.get_one(Photo, bad).object_key
    fitted.store.put(key, b"the disk has rotted")
    for seed in range(1, later_changes + 2):
        fitted.fit(seed=seed)
    assert bad not in fitted.rows()
    fitted.store.put(key, photo_bytes(0))  # restored from a backup
    job_id = fitted.job_of(bad).id
    with fitted.catalog.write() as session:
        job = session.get_one(Job, job_id)
        # Uploading the same bytes again queues the job as it is; POST /jobs/{id}/retry asks.
        retry_job(session, job) if later_changes else requeue_job_as_new(job)
    fitted.drain()
    assert fitted.job(job_id).state == JobState.SUCCEEDED
    assert bad in fitted.rows()


def test_a_cancelled_reindex_job_is_queued_again(fitted: Harness) -> None:
    job_id, new = fitted.build(seed=1)
    fitted.advance()
    first = fitted.reindex_jobs(new)[0]
    with fitted.catalog.write() as session:
        cancel_job(session.get_one(Job, first.id))
    assert fitted.finish(job_id).state == JobState.SUCCEEDED
    assert set(fitted.rows(new)) == set(photo_ids(fitted))


def test_photos_of_a_chunk_that_was_discarded_after_it_was_queued_are_described_again(
    fitted: Harness,
) -> None:
    job_id, new = fitted.build(seed=1)
    fitted.advance()
    fitted.drain()
    with fitted.catalog.write() as session:
        discard_chunk(session, list_live_chunks(session, new)[0].id)
    assert len(fitted.rows(new)) < PHOTOS
    assert fitted.finish(job_id).state == JobState.SUCCEEDED
    assert set(fitted.rows(new)) == set(photo_ids(fitted))


def test_a_change_that_loses_more_than_one_per_cent_of_the_searchable_photos_fails(
    fitted: Harness,
) -> None:
    old = fitted.active().id
    job_id, new = fitted.build(seed=1)
    bad = photo_ids(fitted)[2]
    spoil(fitted, bad)
    job = fitted.finish(job_id)
    assert (job.state, job.progress_failed) == (JobState.FAILED, 1)
    assert problem_of(job)["code"] == "change_loses_photos"
    assert (problem_of(job)["lost"], problem_of(job)["searchable"]) == (1, PHOTOS)
    assert problem_of(job)["file_ids"] == [str(bad)]
    assert f"the photo {bad}: The photo can't be decoded" in problem_of(job)["detail"]
    assert "&map=" in problem_of(job)["detail"]
    assert (fitted.active().id, fitted.searchable()) == (old, PHOTOS)
    assert fitted.generation(new).state == GenerationState.ABANDONED
    fitted.delete(bad)
    assert fitted.fit(seed=1).state == JobState.SUCCEEDED


def test_photos_that_failed_before_do_not_count_as_lost_and_are_described_again(
    vlads: Harness,
) -> None:
    photos = vlads.upload(*range(3))
    spoil(vlads, photos[0])
    assert vlads.fit().state == JobState.SUCCEEDED
    assert set(vlads.rows()) == set(photos[1:])
    assert failed_photos(vlads) == {photos[0]}

    again = vlads.fit(seed=1)  # its bytes are still no photo
    assert again.state == JobState.SUCCEEDED
    assert (again.result or {})["failed"] == 1
    assert failed_photos(vlads) == {photos[0]}

    with vlads.catalog.read() as session:
        key = session.get_one(Photo, photos[0]).object_key
    vlads.store.put(key, photo_bytes(0))
    assert vlads.fit(seed=2).state == JobState.SUCCEEDED
    assert set(vlads.rows()) == set(photos)
    assert failed_photos(vlads) == set()
    assert vlads.job_of(photos[0]).state == JobState.SUCCEEDED


def failed_photos(harness: Harness) -> set[UUID]:
    with harness.catalog.read() as session:
        return set(session.scalars(select_failed_photos(harness.map_id)))


def test_a_restarted_steward_queues_no_reindex_job_twice(fitted: Harness) -> None:
    _, new = fitted.build(seed=1)
    fitted.advance()
    advance_model_changes(fitted.catalog, fitted.wakeups)
    assert len(fitted.reindex_jobs(new)) == PHOTOS


def test_jobs_left_by_a_killed_switch_are_settled_in_small_transactions(
    fitted: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reindex_jobs, "REINDEX_JOBS_PER_TRANSACTION", 2)
    monkeypatch.setattr(reindex_jobs, "DELETED_JOBS_PER_TRANSACTION", 2)
    monkeypatch.setattr(model_changes, "MAX_LOST_SHARE", 0.5)
    job_id, new = fitted.build(seed=1)
    bad = photo_ids(fitted)[:3]
    for photo_id in bad:
        spoil(fitted, photo_id)
    with monkeypatch.context() as killed:
        killed.setattr(model_changes, "settle_photo_jobs", lambda catalog: None)
        assert fitted.finish(job_id).state == JobState.SUCCEEDED
    assert [fitted.job_of(photo_id).state for photo_id in bad] == [JobState.SUCCEEDED] * 3
    collect_garbage(fitted.catalog, fitted.store)
    assert [fitted.job_of(photo_id).state for photo_id in bad] == [JobState.FAILED] * 3
    assert {job.photo_id for job in fitted.reindex_jobs(new)} == set(bad)
