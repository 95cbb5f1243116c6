"""The job runner on SQLite and PostgreSQL: what each failure does to the jobs that were claimed."""

from __future__ import annotations

import threading
from uuid import UUID

import pytest
from sqlalchemy.exc import OperationalError

from shared.catalog.database.session import Catalog
from shared.catalog.jobs import Job, JobKind, JobState
from shared.config.settings import Settings
from shared.errors import Unavailable, Unprocessable
from shared.jobs.runner import JobInterrupted, JobRunner, StepOutcome, reclaim_expired_leases
from tests.support.catalog_rows import add_job, add_map, read_job, take

KINDS = (JobKind.INDEX, JobKind.DESCRIBE, JobKind.EVALUATE)
UNAVAILABLE = Unavailable("object_store_unavailable", "The object store is unreachable.")
REFUSED = Unprocessable("vocabulary_unusable", "The vocabulary does not fit.")


class Recorder:
    """A runner, and the outcomes that it reports."""

    def __init__(self, catalog: Catalog, settings: Settings) -> None:
        self.outcomes: list[tuple[JobKind, StepOutcome, int]] = []
        self.runner = JobRunner(catalog, settings, "worker", KINDS, self.record)

    def record(self, kind: JobKind, outcome: StepOutcome, jobs: int) -> None:
        self.outcomes.append((kind, outcome, jobs))


@pytest.fixture
def recorder(catalog: Catalog, settings: Settings) -> Recorder:
    return Recorder(catalog, settings)


def queue(catalog: Catalog, kind: JobKind, count: int = 1) -> list[UUID]:
    with catalog.write() as session:
        map_id = add_map(session).id
        return [add_job(session, map_id, kind=kind).id for _ in range(count)]


@pytest.mark.parametrize(
    ("kind", "error", "state", "attempts", "code", "outcome"),
    [
        (JobKind.INDEX, UNAVAILABLE, "queued", 0, "object_store_unavailable", StepOutcome.PAUSED),
        (JobKind.EVALUATE, OSError("disk"), "queued", 0, None, StepOutcome.PAUSED),
        (JobKind.INDEX, REFUSED, "queued", 0, "vocabulary_unusable", StepOutcome.FAILED),
        (JobKind.DESCRIBE, REFUSED, "failed", 0, "vocabulary_unusable", StepOutcome.FAILED),
        (JobKind.EVALUATE, REFUSED, "failed", 0, "vocabulary_unusable", StepOutcome.FAILED),
        (JobKind.EVALUATE, JobInterrupted(), "queued", 0, None, StepOutcome.INTERRUPTED),
        (JobKind.INDEX, RuntimeError("bug"), "queued", 1, None, StepOutcome.CRASHED),
    ],
)
def test_a_failure_requeues_or_fails_the_job(
    catalog: Catalog,
    recorder: Recorder,
    kind: JobKind,
    error: Exception,
    state: str,
    attempts: int,
    code: str | None,
    outcome: StepOutcome,
) -> None:
    (job_id,) = queue(catalog, kind)

    def fail(_: Job) -> None:
        raise error

    assert recorder.runner.run_next(fail)
    job = read_job(catalog, job_id)
    assert (job.state, job.attempts, job.lease_token) == (JobState(state), attempts, None)
    assert (job.error and job.error["code"]) == code
    is_delayed = state == "queued" and outcome in (StepOutcome.PAUSED, StepOutcome.FAILED)
    assert (job.run_after is not None) is is_delayed
    assert recorder.outcomes == [(kind, outcome, 1)]


def test_a_job_that_was_taken_over_meanwhile_is_left_to_its_new_worker(
    catalog: Catalog, recorder: Recorder
) -> None:
    (job_id,) = queue(catalog, JobKind.DESCRIBE)

    def lose_lease(_: Job) -> None:
        with catalog.write() as session:
            reclaim_expired_leases(session, all_leases=True)
        take(catalog, worker="another")
        raise REFUSED

    assert recorder.runner.run_next(lose_lease)
    job = read_job(catalog, job_id)
    assert (job.state, job.worker, job.error) == (JobState.RUNNING, "another", None)


def test_the_job_loop_continues_after_an_outage_of_the_catalog(
    recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shared.jobs.runner.UNAVAILABLE_RETRY_SECONDS", 0.0)
    stop, calls = threading.Event(), iter(["away", "job", "none"])
    waits = []

    def work() -> bool:
        call = next(calls)
        if call == "away":
            raise OperationalError("the catalog is away", None, Exception())
        return call == "job"

    def wait(_seconds: float) -> None:
        waits.append("waited")
        stop.set()

    recorder.runner.run(work, stop, wait)
    assert waits == ["waited"], "only without a job"


def test_requeued_jobs_are_claimable_at_once(catalog: Catalog, recorder: Recorder) -> None:
    queue(catalog, JobKind.INDEX, 2)
    claimed = recorder.runner.claim(limit=2)
    assert claimed is not None
    assert not recorder.runner.has_jobs()
    with claimed.lease:
        recorder.runner.requeue(claimed)
    assert recorder.outcomes == [(JobKind.INDEX, StepOutcome.INTERRUPTED, 2)]
    assert recorder.runner.has_jobs()
