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

from services.steward.batches.bring_in import BringIn
from services.steward.batches.list_archive import list_archive
from services.steward.batches.list_prefix import list_prefix
from services.steward.metrics import StewardMetrics
from services.steward.take import Stopped, Taker
from shared.catalog.session import Catalog
from shared.disk_space import DiskSpace
from shared.errors import PlacewiseError, StorageFull
from shared.jobs import Hints, Job, JobKind, JobState
from shared.jobs.batches import (
    BatchItem,
    BatchSource,
    batch_result,
    follow_items,
    list_batch,
    lock_map_and_batch,
    note_progress,
    photos_ahead,
    queued_items,
    waits_for_vocabulary,
)
from shared.jobs.finish import release, release_waiting, succeed
from shared.jobs.leases import held, token_of
from shared.jobs.table import WaitingFor, claimable
from shared.objects import ObjectStore
from shared.settings import Settings

log = logging.getLogger(__name__)

SLICE_SECONDS = 2.0
FOLLOW_SECONDS = 0.5  # between two looks at what the extractors have done
TURN_SECONDS = 0.1  # in which another batch is taken first
AT_ONCE = 50  # items read from the catalog in one go


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
        release_waiting(session, waits)


class BatchWorker:
    """Does batch jobs; `run` until stopped."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        hints: Hints,
        settings: Settings,
        name: str,
        metrics: StewardMetrics | None = None,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._settings = settings
        self._disk = DiskSpace(settings)
        self._bring_in = BringIn(catalog, store, hints, settings)
        counted = metrics or StewardMetrics(CollectorRegistry())
        self._taker = Taker(catalog, settings, name, (JobKind.BATCH,), counted)

    def run(self, stop: threading.Event) -> None:
        """Take batches until `stop` is set."""
        self._taker.run(stop, lambda job: self._slice(job, stop))

    def work_next(self, stop: threading.Event) -> bool:
        """A slice of the next batch; False when there is none."""
        return self._taker.take_next(lambda job: self._slice(job, stop))

    def _slice(self, job: Job, stop: threading.Event) -> None:
        until = time.monotonic() + SLICE_SECONDS
        if not job.params["listed"]:
            self._list(job)
        elif job.attempts >= self._settings.max_attempts:
            self._give_up_next(job)
        try:
            while time.monotonic() < until and (items := self._next_items(job)):
                for item in items:
                    if stop.is_set():
                        raise Stopped
                    self._disk.check()
                    self._bring_in.bring_in(job, item)
                    if time.monotonic() > until:
                        break
        except StorageFull as error:
            log.warning("the batch %s waits for disk space: %s", job.id, error)
            self._rest(job, WaitingFor.DISK_SPACE)
        else:
            self._rest(job)

    def _list(self, job: Job) -> None:
        """Archives and prefixes come without items: the gateway lists files and keys."""
        with self._catalog.write() as session:
            for mine in held(session, token_of(job), [job]):
                mine.stage = "list"
        if job.params["source"] == BatchSource.PREFIX:
            most = self._settings.max_batch_photos
            listing = list_prefix(self._store, job.params["prefix"], most)
        else:
            listing = list_archive(self._bring_in.archive_of(job))
        with self._catalog.write() as session:
            for mine in held(session, token_of(job), [job]):
                mine.params = {**mine.params, "ignored": listing.ignored}
                list_batch(session, mine, listing.items)
                return
        raise Stopped

    def _give_up_next(self, job: Job) -> None:
        """Several workers have died since the last photo came in: the next one may be to blame."""
        error = PlacewiseError(
            "worker_fell",
            f"The steward died {job.attempts} times while it brought this photo in. If the photo "
            "is fine, look at the steward's log and memory, then upload it again.",
        )
        with self._catalog.read() as session:
            suspects = queued_items(session, job.id, 1)
        if not suspects:
            raise error
        log.error("item %d of the batch %s has killed its workers", suspects[0].number, job.id)
        self._bring_in.fail(job, suspects[0], error.as_problem())

    def _next_items(self, job: Job) -> list[BatchItem]:
        """The next queued items, as many as the extractors have room for."""
        most = self._settings.batch_ahead_photos
        with self._catalog.read() as session:
            room = most - photos_ahead(session, most)
            return queued_items(session, job.id, min(AT_ONCE, room)) if room > 0 else []

    def _rest(self, job: Job, waiting_for: WaitingFor | None = None) -> None:
        """The slice's end: note the progress; end the batch, or say when its queued items go on, or
        what they wait for."""
        with self._catalog.write() as session:
            mine = lock_map_and_batch(session, job, token_of(job))
            if mine is None:
                raise Stopped
            mine.attempts = 0
            counts = follow_items(session, mine)
            if counts[JobState.QUEUED]:
                pause = 0.0 if waiting_for else self._pause_seconds(session, mine)
                release(mine, after_seconds=pause, waiting_for=waiting_for)
                return
            if counts[JobState.RUNNING]:
                mine.stage = "describe"
                waits = waits_for_vocabulary(session, mine)
                release(
                    mine,
                    after_seconds=FOLLOW_SECONDS,
                    waiting_for=WaitingFor.VOCABULARY if waits else None,
                )
                return
            succeed(mine, batch_result(session, mine, counts))
            note_progress(mine, counts)
        self._bring_in.forget(job)

    def _pause_seconds(self, session: Session, job: Job) -> float:
        most = self._settings.batch_ahead_photos
        if photos_ahead(session, most) == most:
            return FOLLOW_SECONDS
        other = select(Job.id).where(claimable((JobKind.BATCH,)), Job.id != job.id)
        return TURN_SECONDS if session.scalar(select(exists(other))) else 0.0
