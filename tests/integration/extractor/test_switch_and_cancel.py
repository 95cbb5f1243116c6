"""Model changes: cancellation, vocabulary imports and switches between extractors."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from services.extractor import fits
from shared.catalog.generations import GenerationState
from shared.catalog.maps import Map
from shared.descriptors.extractor import Extractor
from shared.descriptors.vocabulary import decode_centres
from shared.jobs import JobKind, JobState, progress
from shared.jobs.progress import JobProgress
from tests.integration.extractor.model_changes import (
    PHOTOS,
    WIDTH,
    import_file,
    npy,
    photo_ids,
    some_centres,
)
from tests.integration.harness import FIT, Harness, expected_row, same
from tests.support.catalog_rows import failure_code, problem_of
from tests.support.photos import photo_bytes

pytestmark = pytest.mark.databases("postgresql")


@pytest.mark.parametrize("stage", ["sample", "cluster"])
def test_a_fit_can_be_cancelled_in_each_stage(
    fitted: Harness, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    old = fitted.active().id
    job_id = fitted.start(JobKind.FIT, **{**FIT, "seed": 1})
    real = JobProgress.update

    def cancel_there(self: JobProgress, done: int, now: str | None = None) -> None:
        if now == stage:
            fitted.cancel(job_id)
        real(self, done, now)

    with monkeypatch.context() as patched:
        patched.setattr(progress, "PROGRESS_SECONDS", 0.0)
        patched.setattr(JobProgress, "update", cancel_there)
        fitted.drain()
    assert fitted.job(job_id).state == JobState.CANCELLED
    assert fitted.building() is None
    assert not fitted.worker.fits.run_next(threading.Event())
    assert (fitted.active().id, fitted.searchable()) == (old, PHOTOS)
    assert fitted.fit(seed=1).state == JobState.SUCCEEDED
    assert fitted.active().id != old


def test_a_stopping_worker_requeues_its_fit(
    fitted: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = fitted.start(JobKind.FIT, **{**FIT, "seed": 1})
    stop = threading.Event()
    real = fits.compute_fit

    def stop_and_fit(*arguments: Any) -> Any:
        stop.set()
        return real(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(fits, "compute_fit", stop_and_fit)
        fitted.worker.fits.run_next(stop)
    job = fitted.job(job_id)
    assert (job.state, job.lease_token, job.attempts) == (JobState.RUNNING, None, 0)
    assert fitted.finish(job_id).state == JobState.SUCCEEDED


def test_a_fit_can_be_cancelled_while_photos_are_described(
    fitted: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = fitted.active().id
    for when in ("before", "in between", "in a batch"):
        job_id, new = fitted.build(seed=1)
        fitted.advance()
        stop = threading.Event()
        if when == "in between":
            with monkeypatch.context() as patched:
                patched.setattr(Extractor, "describe", _first(Extractor.describe, stop.set))
                fitted.worker.drain(stop)
            assert 0 < len(fitted.rows(new)) < PHOTOS
        if when == "in a batch":
            with monkeypatch.context() as patched:
                patched.setattr(
                    Extractor,
                    "describe",
                    _first(Extractor.describe, functools.partial(fitted.cancel, job_id)),
                )
                fitted.drain()
            assert fitted.rows(new) == {}
        else:
            fitted.cancel(job_id)
        assert fitted.job(job_id).state == JobState.CANCELLED
        assert fitted.generation(new).state == GenerationState.ABANDONED
        assert not fitted.drain()
        fitted.advance()
        assert (fitted.active().id, fitted.searchable()) == (old, PHOTOS)
        assert not [j for j in fitted.reindex_jobs(new) if j.state == JobState.QUEUED]
    assert fitted.fit(seed=1).state == JobState.SUCCEEDED


def _first(real: Callable[..., Any], do: Callable[[], None]) -> Callable[..., Any]:
    """`real`, with something done at its first call."""
    calls = iter([do])

    def wrapped(*arguments: Any) -> Any:
        for act in calls:
            act()
            break
        return real(*arguments)

    return wrapped


def test_imported_centres_of_unknown_origin_describe_the_map(vlads: Harness) -> None:
    ids = vlads.upload(1, 2)
    vlads.drain()  # they wait
    centres = some_centres(5)
    job = vlads.finish(import_file(vlads, npy(centres), "mine.npy"))
    assert job.state == JobState.SUCCEEDED
    vocabulary = vlads.vocabulary(vlads.active().vocabulary_id)
    assert (vocabulary.origin, vocabulary.standing) == ("imported", "foreign")
    assert (vocabulary.clusters, vocabulary.dimension) == (5, WIDTH)
    assert vocabulary.provenance == {"learnt_with": "unknown", "imported_from": "mine.npy"}
    stored = decode_centres(vlads.store.get(vocabulary.object_key))
    assert np.array_equal(stored.array, centres)
    rows = vlads.rows()
    assert set(rows) == set(ids)
    assert same(rows[ids[0]], expected_row("test-tiny-vlad", photo_bytes(1), stored))


@pytest.mark.usefixtures("fit_at_four_photos")
def test_an_imported_vocabulary_is_not_replaced_automatically(vlads: Harness) -> None:
    vlads.upload(*range(4))
    vlads.drain()
    bad = vlads.finish(import_file(vlads, npy(some_centres(4)[:, :8])))
    assert bad.state == JobState.FAILED
    assert auto_fit(vlads), "nothing was imported"
    assert vlads.finish(import_file(vlads, npy(some_centres(4)))).state == JobState.SUCCEEDED
    assert not auto_fit(vlads)
    assert vlads.fit_if_due() == []


def auto_fit(harness: Harness) -> bool:
    with harness.catalog.read() as session:
        return session.get_one(Map, harness.map_id).auto_fit


def test_an_unusable_vocabulary_is_refused_with_the_reason_and_changes_nothing(
    fitted: Harness,
) -> None:
    old = fitted.active().id
    broken = some_centres(4)
    broken[2, 3] = np.nan
    unfit = {
        "16": npy(some_centres(4)[:, :8]),  # eight dimensions, and 16 are needed
        "NaN": npy(broken),
        "pickle": npy(np.array([{"a": 1}])),
    }
    for reason, data in unfit.items():
        job = fitted.finish(import_file(fitted, data))
        assert failure_code(job) == "vocabulary_unusable", reason
        assert reason in problem_of(job)["detail"]
    assert (fitted.active().id, fitted.searchable()) == (old, PHOTOS)
    assert fitted.building() is None


def test_switching_back_gives_the_descriptors_of_the_earlier_vocabulary(fitted: Harness) -> None:
    first, before = fitted.active(), fitted.rows()
    fitted.fit(seed=1)
    assert not any(same(before[photo_id], row) for photo_id, row in fitted.rows().items())
    job = fitted.finish(fitted.start(JobKind.SWITCH, vocabulary_id=str(first.vocabulary_id)))
    assert job.state == JobState.SUCCEEDED
    again = fitted.active()
    assert again.id != first.id  # a generation of its own
    assert again.vocabulary_id == first.vocabulary_id
    assert again.spec == first.spec
    rows = fitted.rows()
    assert set(rows) == set(before)
    assert all(same(before[photo_id], row) for photo_id, row in rows.items())


def test_an_impossible_switch_fails_with_the_reason(
    fitted: Harness, harness_of: Callable[[str], Harness]
) -> None:
    old = fitted.active()
    elsewhere = harness_of("test-tiny-vlad")
    elsewhere.upload(1)
    foreign = elsewhere.fit().result
    assert foreign is not None
    for vocabulary_id, code in (
        (foreign["vocabulary_id"], "vocabulary_not_found"),  # of another map
        (None, "vocabulary_unusable"),  # the extractor needs one
    ):
        job = fitted.finish(fitted.start(JobKind.SWITCH, vocabulary_id=vocabulary_id))
        assert failure_code(job) == code
    assert fitted.active().id == old.id


def test_progress_of_a_model_change_is_monotonic(averages: Harness) -> None:
    averages.upload(1)
    averages.drain()
    (photo_id,) = photo_ids(averages)
    averages.delete(photo_id)
    job_id = averages.start(JobKind.SWITCH, vocabulary_id=None)
    averages.drain()  # nothing to describe: its total is 0
    averages.upload(2)
    averages.drain()
    averages.advance()
    assert averages.job(job_id).progress_done >= 0
    assert averages.finish(job_id).state == JobState.SUCCEEDED
