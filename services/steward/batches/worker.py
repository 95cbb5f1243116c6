"""Batch jobs: brought in by slices, as fast as the extractors describe and no faster.

In a thread of its own, beside the steward's duties. A slice ends after SLICE_SECONDS, so that
several batches take turns; what is brought in is never more than BATCH_AHEAD_PHOTOS ahead.
"""

from __future__ import annotations

import logging
import threading
import time

from prometheus_client import CollectorRegistry
from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from services.steward.batches.bring_in import BatchItemImporter
from services.steward.batches.list_archive import list_archive_photos
from services.steward.batches.list_prefix import list_prefix_photos
from services.steward.metrics import StewardMetrics
from services.steward.take import JobInterrupted, JobRunner
from shared.catalog.session import Catalog
from shared.disk_space import DiskSpace
from shared.errors import PlacewiseError, StorageFull
from shared.jobs import Job, JobKind, JobState, Wakeups
from shared.jobs.batches import (
    BatchItem,
    BatchSource,
    add_batch_items,
    count_queued_photos,
    is_waiting_for_vocabulary,
    lock_batch,
    next_queued_items,
    summarise_batch,
    sync_item_states,
    update_batch_progress,
)
from shared.jobs.finish import release_job, succeed_job, wake_waiting_jobs
from shared.jobs.leases import get_lease_token, lock_leased_jobs
from shared.jobs.table import WaitingFor, claimable_condition
from shared.objects import ObjectStore
from shared.settings import Settings

log = logging.getLogger(__name__)

SLICE_SECONDS = 2.0
PROGRESS_POLL_SECONDS = 0.5  # between two looks at what the extractors have done
YIELD_SECONDS = 0.1  # in which another batch is taken first
READ_ITEMS = 50  # items read from the catalog in one go


def resume_batches(catalog: Catalog, settings: Settings) -> None:
    """Let the batches that wait for disk space go on once MIN_FREE_BYTES are free. Of a bucket, how
    much is free is not known: they try their next photo."""
    waits = (Job.kind == JobKind.BATCH) & (Job.waiting_for == WaitingFor.DISK_SPACE)
    with catalog.read() as session:
        if not session.scalar(select(exists(select(Job.id).where(waits)))):
            return
    try:
        DiskSpace(settings).check()
    except StorageFull:
        return
    with catalog.write() as session:
        wake_waiting_jobs(session, waits)


class BatchWorker:
    """Does batch jobs; `run` until stopped."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        hints: Wakeups,
        settings: Settings,
        name: str,
        metrics: StewardMetrics | None = None,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._settings = settings
        self._disk = DiskSpace(settings)
        self._importer = BatchItemImporter(catalog, store, hints, settings)
        counted = metrics or StewardMetrics(CollectorRegistry())
        self._runner = JobRunner(catalog, settings, name, (JobKind.BATCH,), counted)

    def run(self, stop: threading.Event) -> None:
        """Take batches until `stop` is set."""
        self._runner.run(stop, lambda job: self._run_slice(job, stop))

    def run_next(self, stop: threading.Event) -> bool:
        """A slice of the next batch; False when there is none."""
        return self._runner.run_next(lambda job: self._run_slice(job, stop))

    def _run_slice(self, job: Job, stop: threading.Event) -> None:
        until = time.monotonic() + SLICE_SECONDS
        if not job.params["listed"]:
            self._list_items(job)
        elif job.attempts >= self._settings.max_attempts:
            self._fail_suspect_item(job)
        try:
            while time.monotonic() < until and (items := self._next_items(job)):
                for item in items:
                    if stop.is_set():
                        raise JobInterrupted
                    self._disk.check()
                    self._importer.import_item(job, item)
                    if time.monotonic() > until:
                        break
        except StorageFull as error:
            log.warning("the batch %s waits for disk space: %s", job.id, error)
            self._finish_slice(job, WaitingFor.DISK_SPACE)
        else:
            self._finish_slice(job)

    def _list_items(self, job: Job) -> None:
        """Archives and prefixes come without items: the gateway lists files and keys."""
        with self._catalog.write() as session:
            for mine in lock_leased_jobs(session, get_lease_token(job), [job]):
                mine.stage = "list"
        if job.params["source"] == BatchSource.PREFIX:
            most = self._settings.max_batch_photos
            listing = list_prefix_photos(self._store, job.params["prefix"], most)
        else:
            listing = list_archive_photos(self._importer.open_batch_archive(job))
        with self._catalog.write() as session:
            for mine in lock_leased_jobs(session, get_lease_token(job), [job]):
                mine.params = {**mine.params, "ignored": listing.ignored}
                add_batch_items(session, mine, listing.items)
                return
        raise JobInterrupted

    def _fail_suspect_item(self, job: Job) -> None:
        """Several workers have died since the last photo came in: the next one may be to blame."""
        error = PlacewiseError(
            "worker_fell",
            f"The steward died {job.attempts} times while it brought this photo in. If the photo "
            "is fine, look at the steward's log and memory, then upload it again.",
        )
        with self._catalog.read() as session:
            suspects = next_queued_items(session, job.id, 1)
        if not suspects:
            raise error
        log.error("item %d of the batch %s has killed its workers", suspects[0].number, job.id)
        self._importer.fail_item(job, suspects[0], error.as_problem())

    def _next_items(self, job: Job) -> list[BatchItem]:
        """The next queued items, as many as the extractors have room for."""
        most = self._settings.batch_ahead_photos
        with self._catalog.read() as session:
            room = most - count_queued_photos(session, most)
            return next_queued_items(session, job.id, min(READ_ITEMS, room)) if room > 0 else []

    def _finish_slice(self, job: Job, waiting_for: WaitingFor | None = None) -> None:
        """The slice's end: note the progress; end the batch, or say when its queued items go on, or
        what they wait for."""
        with self._catalog.write() as session:
            mine = lock_batch(session, job, get_lease_token(job))
            if mine is None:
                raise JobInterrupted
            mine.attempts = 0
            counts = sync_item_states(session, mine)
            if counts[JobState.QUEUED]:
                pause = 0.0 if waiting_for else self._pause_seconds(session, mine)
                release_job(mine, after_seconds=pause, waiting_for=waiting_for)
                return
            if counts[JobState.RUNNING]:
                mine.stage = "describe"
                waits = is_waiting_for_vocabulary(session, mine)
                release_job(
                    mine,
                    after_seconds=PROGRESS_POLL_SECONDS,
                    waiting_for=WaitingFor.VOCABULARY if waits else None,
                )
                return
            succeed_job(mine, summarise_batch(session, mine, counts))
            update_batch_progress(mine, counts)
        self._importer.close_archive(job)

    def _pause_seconds(self, session: Session, job: Job) -> float:
        most = self._settings.batch_ahead_photos
        if count_queued_photos(session, most) == most:
            return PROGRESS_POLL_SECONDS
        other = select(Job.id).where(claimable_condition((JobKind.BATCH,)), Job.id != job.id)
        return YIELD_SECONDS if session.scalar(select(exists(other))) else 0.0
