"""Batches that overlap: one is decoded, one on the model, one being published, and none is lost."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import pytest

from services.extractor.publish import publish
from services.extractor.worker import ExtractorWorker
from shared.descriptors.extractor import Extractor
from shared.jobs import JobState
from tests.integration.extractor.small_gpu import make_too_heavy
from tests.integration.harness import Harness, expected_row, same
from tests.support.catalog_rows import problem_of, set_columns
from tests.support.photos import photo_bytes
from tests.support.waiting import wait_until

pytestmark = pytest.mark.databases("postgresql")

WAIT_SECONDS = 90.0
BATCH = 4  # tests.integration.conftest


class Gate:
    """Publishing of bulk batches waits here, and what happens is written down in its order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.open = threading.Event()
        self.waiting = threading.Event()
        self.seen: list[str] = []
        self.niceness: dict[int, int] = {}
        describe = Extractor.describe

        def described(made: Extractor, pixels: Any, *made_with: Any) -> Any:
            self.seen.append(f"describe {len(pixels)}")
            self.niceness[len(pixels)] = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
            return describe(made, pixels, *made_with)

        def published(context: Any, batch: Any, *more: Any) -> None:
            if len(batch.jobs) == BATCH:
                self.waiting.set()
                assert self.open.wait(WAIT_SECONDS)
            publish(context, batch, *more)
            self.seen.append(f"published {len(batch.jobs)}")

        monkeypatch.setattr(Extractor, "describe", described)
        monkeypatch.setattr("services.extractor.describe.publish", published)

    def await_seen(self, *expected: str) -> None:
        wait_until(lambda: self.seen == list(expected), WAIT_SECONDS)


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Gate:
    return Gate(monkeypatch)


def in_thread(do: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    """Runs it beside the test; its result comes into the list."""
    results: list[Any] = []
    thread = threading.Thread(target=lambda: results.append(do()))
    thread.start()
    return thread, results


def test_next_batch_is_described_while_one_is_published_and_the_one_after_waits(
    averages: Harness, gate: Gate
) -> None:
    photo_ids = averages.upload(*range(3 * BATCH))
    draining, results = in_thread(averages.drain)
    gate.await_seen("describe 4", "describe 4")
    time.sleep(0.2)
    assert gate.seen == ["describe 4"] * 2, "the third one has no place to go"
    gate.open.set()
    draining.join()
    assert gate.seen.index("published 4") == 2
    assert sorted(gate.seen) == ["describe 4"] * 3 + ["published 4"] * 3
    assert results == [True]
    assert averages.ended() == (12, 0)
    rows = averages.rows()
    for number, photo_id in enumerate(photo_ids):
        assert same(rows[photo_id], expected_row("test-tiny-avg", photo_bytes(number)))


def test_leases_of_batches_that_wait_to_be_published_are_extended(
    averages: Harness, gate: Gate, make_worker: Callable[..., ExtractorWorker]
) -> None:
    photo_ids = averages.upload(*range(2 * BATCH))
    lease = timedelta(seconds=1.5)
    worker = make_worker(lease_seconds=lease.total_seconds())

    def leases() -> list[datetime]:
        found = [averages.job_of(photo_id).lease_until for photo_id in photo_ids]
        return [lease_until for lease_until in found if lease_until is not None]

    draining, results = in_thread(lambda: worker.drain(threading.Event()))
    gate.await_seen("describe 4", "describe 4")
    extended = max(leases()) + 2 * lease
    wait_until(lambda: min(leases()) >= extended, WAIT_SECONDS)
    gate.open.set()
    draining.join()
    assert results == [True]
    assert averages.ended() == (2 * BATCH, 0)


def test_query_is_published_at_once_while_bulk_batches_wait_to_be(
    averages: Harness, gate: Gate
) -> None:
    averages.upload(0)
    averages.drain()
    averages.upload(*range(1, 2 * BATCH + 1))
    draining, _ = in_thread(averages.drain)
    assert gate.waiting.wait(WAIT_SECONDS)
    job_id = averages.ask(photo_bytes(99))
    assert averages.await_end(job_id) == JobState.SUCCEEDED
    assert "published 4" not in gate.seen
    assert gate.niceness[1] < gate.niceness[BATCH], "the query gets more of the processors"
    gate.open.set()
    draining.join()
    assert len(averages.rows()) == 2 * BATCH + 1


def test_job_marked_alone_starts_after_all_others_have_ended(averages: Harness, gate: Gate) -> None:
    averages.upload(*range(BATCH))
    (suspect,) = averages.upload(50)
    job_id = averages.job_of(suspect).id
    set_columns(averages.catalog, job_id, alone=True)
    draining, _ = in_thread(averages.drain)
    assert gate.waiting.wait(WAIT_SECONDS)
    time.sleep(0.3)
    assert gate.seen == ["describe 4"]
    assert averages.job(job_id).claimed_together == 0, "it could not be blamed for a fall yet"
    gate.open.set()
    draining.join()
    assert gate.seen == ["describe 4", "published 4", "describe 1", "published 1"]


def test_stopping_worker_publishes_what_it_has_described_and_gives_back_the_rest(
    averages: Harness, gate: Gate
) -> None:
    photo_ids = averages.upload(*range(3 * BATCH))
    stop = threading.Event()
    draining, results = in_thread(lambda: averages.worker.drain(stop))
    gate.await_seen("describe 4", "describe 4")
    stop.set()
    gate.open.set()
    draining.join()
    assert results == [True]
    assert averages.ended() == (8, 0)
    assert set(averages.rows()) == set(photo_ids[:8])
    left = [averages.job_of(photo_id) for photo_id in photo_ids[8:]]
    assert all(job.state == JobState.QUEUED and job.lease_token is None for job in left)
    assert all(job.attempts == 0 and not job.alone for job in left)


def test_jobs_of_a_batch_whose_publishing_crashed_are_retried_alone_and_the_next_batch_is_not(
    averages: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = iter(range(100))

    def crash_once(*arguments: Any) -> Any:
        if next(calls) == 0:
            raise RuntimeError("a row of the wrong length")
        return publish(*arguments)

    monkeypatch.setattr("services.extractor.describe.publish", crash_once)
    photo_ids = averages.upload(*range(2 * BATCH))
    averages.drain()
    jobs = [averages.job_of(photo_id) for photo_id in photo_ids]
    assert {job.state for job in jobs} == {JobState.SUCCEEDED}
    assert [job.alone for job in jobs] == [True] * BATCH + [False] * BATCH
    assert {job.attempts for job in jobs} == {0}


def test_photo_that_the_gpu_can_not_hold_fails_alone_and_is_not_tried_again(
    averages: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_too_heavy(monkeypatch, 7)
    photo_ids = averages.upload(1, 7, 2)
    averages.drain()
    assert averages.ended() == (2, 1)
    refused = averages.job_of(photo_ids[1])
    assert (refused.state, refused.attempts) == (JobState.FAILED, 0)
    assert problem_of(refused)["code"] == "gpu_out_of_memory"
    rows = averages.rows()
    for number, photo_id in ((1, photo_ids[0]), (2, photo_ids[2])):
        assert same(rows[photo_id], expected_row("test-tiny-avg", photo_bytes(number)))
