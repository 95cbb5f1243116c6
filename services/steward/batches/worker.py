"""Batch jobs: brought in by slices, as fast as the extractors describe and no faster.

In a thread of its own, beside the steward's duties. A slice ends after SLICE_SECONDS, so that
several batches take turns; what is brought in is never more than BATCH_AHEAD_PHOTOS ahead.

One photo of a batch, by the path of an upload: its bytes into the store, its checks, its row.

The photo's row, its job's and the item's are one transaction, under the batch's lease. What is
refused leaves no bytes; what a kill leaves is an orphan that no row knows.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any
from uuid import UUID

from prometheus_client import CollectorRegistry
from sqlalchemy import exists, select
from sqlalchemy.orm import Session

from services.steward.archives import Archive, ArchiveLimits, open_archive
from services.steward.batches.listing import (
    list_archive_photos,
    list_prefix_photos,
    member_from_location,
)
from services.steward.job_runner import JobInterrupted, JobRunner
from services.steward.metrics import StewardMetrics
from shared.catalog.batch_items import (
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
from shared.catalog.jobs import WaitingFor, claimable_condition
from shared.catalog.session import Catalog
from shared.config.disk_space import DiskSpace
from shared.config.settings import Settings
from shared.errors import InvalidRequest, PlacewiseError, StorageFull, Unavailable
from shared.imaging.file_formats import PHOTO_SIGNATURE_BYTES
from shared.ingest.store_photo import PhotoQuota, StoreResult, insert_photo, retry_on_conflict
from shared.ingest.validation import (
    StoredUpload,
    StreamValidator,
    ValidatedPhoto,
    base_name,
    check_photo_signature,
    validate_photo,
)
from shared.jobs import Job, JobKind, JobState, Priority, Wakeups
from shared.jobs.leases import get_lease_token, lock_leased_jobs
from shared.jobs.transitions import release_job, succeed_job, wake_waiting_jobs
from shared.storage import ObjectStore
from shared.storage.keys import new_original_key

log = logging.getLogger(__name__)

OBJECT_READ_BYTES = 256 * 1024
MAX_OPEN_ARCHIVES = 4  # a gzipped one has to be unpacked from its begin when it is opened anew


class BatchItemImporter:
    """Brings in items; keeps the archives open that it reads from."""

    def __init__(
        self, catalog: Catalog, store: ObjectStore, hints: Wakeups, settings: Settings
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._hints = hints
        self._settings = settings
        self._quota = PhotoQuota(catalog)
        self._archives: OrderedDict[UUID, Archive] = OrderedDict()

    def open_batch_archive(self, job: Job) -> Archive:
        """The batch's archive. Raises as `open_archive` does."""
        if job.id not in self._archives:
            limits = ArchiveLimits(self._settings.max_batch_photos, self._settings.max_archive_size)
            self._archives[job.id] = open_archive(self._store, job.params["object_key"], limits)
        self._archives.move_to_end(job.id)
        while len(self._archives) > MAX_OPEN_ARCHIVES:
            self._archives.popitem(last=False)
        return self._archives[job.id]

    def close_archive(self, job: Job) -> None:
        """The batch has ended, or its archive can't be trusted to be where it was."""
        self._archives.pop(job.id, None)

    def import_item(self, job: Job, item: BatchItem) -> None:
        """Let the item become a photo with its job, or fail with its reason.

        Raises Stopped when the batch is no longer ours, and Unavailable and OSError when the store
        is away.
        """
        uploaded = job.params["source"] == BatchSource.FILES
        key = item.object_key if uploaded and item.object_key else new_original_key()
        try:
            received = (
                self._received_upload(item) if uploaded else self._copy_to_store(job, item, key)
            )
            key_id = UUID(job.params["key_id"]) if "key_id" in job.params else None
            incoming = validate_photo(
                self._store, received, self._settings.max_image_pixels, key_id
            )
            with self._place_for(job, key_id):
                stored = retry_on_conflict(lambda: self._commit(job, item, incoming))
        except Unavailable:
            raise
        except JobInterrupted:
            # Cancelled: its own, unlike an uploaded file, no other steward will go on with.
            if not uploaded:
                self._store.delete(key)
            raise
        except PlacewiseError as error:
            self._fail_with_line(job, item, error)
            self._store.delete(key)
            return
        if stored.queued:
            self._hints.send()
        if stored.photo.object_key != key:
            self._store.delete(key)

    def _place_for(self, job: Job, key_id: UUID | None) -> AbstractContextManager[None]:
        """In which a photo is stored through the key that the batch came in with.
        TooManyRequests (`photo_quota_reached`)."""
        if key_id is None or job.params["max_photos"] is None:
            return contextlib.nullcontext()
        return self._quota.reserve(key_id, job.params["max_photos"])

    def _received_upload(self, item: BatchItem) -> StoredUpload:
        """The file that the gateway has stored."""
        assert item.object_key is not None
        return StoredUpload(
            key=item.object_key,
            filename=base_name(item.name),
            size_bytes=item.source["size_bytes"],
            sha256=item.source["sha256"],
            first_bytes=self._store.read_range(item.object_key, 0, PHOTO_SIGNATURE_BYTES),
            fields=item.fields,
        )

    def _copy_to_store(self, job: Job, item: BatchItem, key: str) -> StoredUpload:
        """The member or object, written under `key` while it is checked."""
        file = StreamValidator(self._settings.max_file_size, check_photo_signature)
        writer = self._store.writer(key)
        try:
            for piece in self._read_item(job, item):
                file.add(piece)
                writer.write(piece)
            file.end()
            if not file.size_bytes:
                raise InvalidRequest("empty_file", "The file is empty.")
            writer.commit()
        finally:
            writer.abort()
        return StoredUpload(
            key=key,
            filename=base_name(item.name),
            size_bytes=file.size_bytes,
            sha256=file.sha256,
            first_bytes=file.first_bytes,
            fields=item.fields,
        )

    def _read_item(self, job: Job, item: BatchItem) -> Iterator[bytes]:
        if item.object_key is None:
            yield from self.open_batch_archive(job).read(
                member_from_location(item.name, item.source)
            )
            return
        with self._store.open(item.object_key) as file:
            while piece := file.read(OBJECT_READ_BYTES):
                yield piece

    def _commit(self, job: Job, item: BatchItem, incoming: ValidatedPhoto) -> StoreResult:
        with self._catalog.write() as session:
            mine = self._lock_item(session, job, item)
            stored = insert_photo(session, job.map_id, incoming, Priority.BATCH)
            # Without a job it was described long ago; else the item ends as that job does.
            mine.state = JobState.RUNNING if stored.job is not None else JobState.SUCCEEDED
            mine.photo_id, mine.photo_job_id = stored.photo.id, stored.photo.job_id
            mine.already_there = stored.photo.object_key != incoming.received.key
            return stored

    def _fail_with_line(self, job: Job, item: BatchItem, error: PlacewiseError) -> None:
        problem = error.as_problem()
        if item.line is not None:
            problem |= {"line": item.line, "detail": f"Line {item.line}: {error.detail}"}
        self.fail_item(job, item, problem)

    def fail_item(self, job: Job, item: BatchItem, problem: dict[str, Any]) -> None:
        """The item ends with the problem; Stopped when the batch is no longer ours."""
        with self._catalog.write() as session:
            mine = self._lock_item(session, job, item)
            mine.state, mine.error = JobState.FAILED, problem

    @staticmethod
    def _lock_item(session: Session, job: Job, item: BatchItem) -> BatchItem:
        """The queued item, under the batch's lock."""
        for mine in lock_leased_jobs(session, get_lease_token(job), [job]):
            mine.attempts = 0  # it gets on: what has killed a worker before was not this item
            return session.get_one(BatchItem, (job.id, item.number))
        raise JobInterrupted


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
