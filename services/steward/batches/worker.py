"""Worker for batch jobs: imports the photos of a batch in slices, with backpressure.

It runs in a thread of its own, parallel to the periodic tasks. A slice ends after SLICE_SECONDS, so
that several batches take turns, and at most `ahead_photos` photos wait for the extractors.

A photo takes the path of an upload: its bytes are stored and checked, then the photo row, its job
and the item are written in one transaction, under the batch's lease. The bytes of a rejected photo
are deleted; a crash leaves an orphan object.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any
from uuid import UUID

from prometheus_client import CollectorRegistry
from sqlalchemy import exists, select, update
from sqlalchemy.orm import Session

from services.steward.metrics import StewardMetrics
from services.steward.periodic_tasks import periodic_task
from shared.catalog.batch_items import (
    BatchItem,
    BatchSource,
    add_batch_items,
    count_queued_photos,
    next_queued_items,
    summarise_batch,
    sync_item_states,
    update_batch_progress,
)
from shared.catalog.database.base import for_update
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import UNFINISHED_STATES, WaitingFor, claimable_condition
from shared.config.disk_space import DiskSpace
from shared.config.settings import Settings
from shared.errors import (
    InvalidRequest,
    PlacewiseError,
    StorageFull,
    TooLarge,
    Unavailable,
    Unprocessable,
)
from shared.imaging.file_formats import PHOTO_SIGNATURE_BYTES, PHOTO_SUFFIXES, photo_suffix
from shared.ingest.photo_metadata import parse_relative_path
from shared.ingest.store_photo import PhotoQuota, StoreResult, insert_photo
from shared.ingest.validation import (
    StoredUpload,
    StreamValidator,
    ValidatedPhoto,
    base_name,
    check_photo_signature,
    validate_photo,
)
from shared.jobs import Job, JobKind, JobState, Priority, Wakeups
from shared.jobs.leases import lock_leased_job
from shared.jobs.runner import MAX_ATTEMPTS, JobInterrupted, JobRunner
from shared.jobs.transitions import cancel_batch_items, requeue_job, succeed_job
from shared.storage import ObjectStore
from shared.storage.keys import IMPORTS, new_original_key
from shared.storage.protocol import writing
from shared.utm_filenames import upload_fields_of_file_name

log = logging.getLogger(__name__)

OBJECT_READ_BYTES = 256 * 1024


class _BatchItemImporter:
    def __init__(
        self, catalog: Catalog, store: ObjectStore, wakeups: Wakeups, settings: Settings
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._wakeups = wakeups
        self._settings = settings
        self._quota = PhotoQuota(catalog)

    def import_item(self, job: Job, item: BatchItem) -> None:
        """Store the item as a photo with its job, or fail the item.

        Raises:
            JobInterrupted: The batch lost its lease.
            Unavailable, OSError: The object store can't be reached.
        """
        uploaded = job.params["source"] == BatchSource.FILES
        new_key = new_original_key(photo_suffix(item.name))
        key = item.object_key if uploaded and item.object_key else new_key
        try:
            stored_upload = (
                self._received_upload(item) if uploaded else self._copy_to_store(item, key)
            )
            key_id = UUID(job.params["key_id"]) if "key_id" in job.params else None
            photo = validate_photo(
                self._store, stored_upload, self._settings.max_image_pixels, key_id
            )
            if photo.fields.relative_path is None:
                path = parse_relative_path(item.name.removeprefix(IMPORTS))
                photo = replace(photo, fields=replace(photo.fields, relative_path=path))
            with self._reserve_quota(job, key_id):
                result = self._commit(job, item, photo)
        except Unavailable:
            raise
        except JobInterrupted:
            # Another steward would copy the object again; an uploaded file is needed by it.
            if not uploaded:
                self._store.delete(key)
            raise
        except PlacewiseError as error:
            self._fail_with_line(job, item, error)
            self._store.delete(key)
            return
        if result.queued:
            self._wakeups.send()
        if result.unused_key is not None:
            self._store.delete(result.unused_key)

    def _reserve_quota(self, job: Job, key_id: UUID | None) -> AbstractContextManager[None]:
        if key_id is None or job.params["max_photos"] is None:
            return contextlib.nullcontext()
        return self._quota.reserve(key_id, job.params["max_photos"])

    def _received_upload(self, item: BatchItem) -> StoredUpload:
        assert item.object_key is not None
        return StoredUpload(
            key=item.object_key,
            filename=base_name(item.name),
            size_bytes=item.source["size_bytes"],
            sha256=item.source["sha256"],
            first_bytes=self._store.read_range(item.object_key, 0, PHOTO_SIGNATURE_BYTES),
            fields=item.fields,
        )

    def _copy_to_store(self, item: BatchItem, key: str) -> StoredUpload:
        """Copy the item's object to `key` and validate it meanwhile."""
        assert item.object_key is not None
        validator = StreamValidator(self._settings.max_file_size, check_photo_signature)
        with self._store.open(item.object_key) as file, writing(self._store, key) as writer:
            while piece := file.read(OBJECT_READ_BYTES):
                validator.add(piece)
                writer.write(piece)
            validator.end()
            if not validator.size_bytes:
                raise InvalidRequest("empty_file", "The file is empty.")
        return StoredUpload(
            key=key,
            filename=base_name(item.name),
            size_bytes=validator.size_bytes,
            sha256=validator.sha256,
            first_bytes=validator.first_bytes,
            fields=item.fields,
        )

    def _commit(self, job: Job, item: BatchItem, photo: ValidatedPhoto) -> StoreResult:
        with self._catalog.write() as session:
            locked_item = self._lock_item(session, job, item)
            result = insert_photo(session, job.map_id, photo, Priority.BATCH)
            # A photo without a job is already described; else the item ends as that job does.
            locked_item.state = JobState.RUNNING if result.job is not None else JobState.SUCCEEDED
            locked_item.photo_id, locked_item.photo_job_id = result.photo.id, result.photo.job_id
            locked_item.already_there = result.already_there
            return result

    def _fail_with_line(self, job: Job, item: BatchItem, error: PlacewiseError) -> None:
        problem = error.as_problem()
        if item.line is not None:
            problem |= {"line": item.line, "detail": f"Line {item.line}: {error.detail}"}
        self.fail_item(job, item, problem)

    def fail_item(self, job: Job, item: BatchItem, problem: dict[str, Any]) -> None:
        """Fail the item with the problem; JobInterrupted if the batch lost its lease."""
        with self._catalog.write() as session:
            locked_item = self._lock_item(session, job, item)
            locked_item.state, locked_item.error = JobState.FAILED, problem

    @staticmethod
    def _lock_item(session: Session, job: Job, item: BatchItem) -> BatchItem:
        """Return the item under the batch's lock; JobInterrupted if the batch lost its lease."""
        leased = lock_leased_job(session, job)
        if leased is None:
            raise JobInterrupted
        leased.attempts = 0  # progress: an earlier crash was not caused by this item
        return session.get_one(BatchItem, (job.id, item.number))


SLICE_SECONDS = 2.0
PROGRESS_POLL_SECONDS = 0.5  # between two checks of the extractors' progress
YIELD_SECONDS = 0.1  # pause of a batch, so that another one is claimed first
AHEAD_BATCHES = 32  # photos, in batches of BATCH_PHOTOS, that a batch job may queue at once
READ_ITEMS = 50  # items per query


@periodic_task(5.0)
def resume_batches(catalog: Catalog, settings: Settings) -> None:
    """Wake the batches that wait for disk space once MIN_FREE_BYTES are free.

    The free space of a bucket is unknown: its batches are woken and try their next photo.
    """
    waits = (Job.kind == JobKind.BATCH) & (Job.waiting_for == WaitingFor.DISK_SPACE)
    with catalog.read() as session:
        if not session.scalar(select(exists(select(Job.id).where(waits)))):
            return
    try:
        DiskSpace(settings).check()
    except StorageFull:
        return
    with catalog.write() as session:
        session.execute(update(Job).where(waits).values(waiting_for=None))


@periodic_task(1.0)
def cancel_items_of_ended_batches(catalog: Catalog) -> None:
    """Cancel the photos of cancelled and failed batches that are still being indexed."""
    is_ended = (Job.kind == JobKind.BATCH) & Job.state.in_((JobState.CANCELLED, JobState.FAILED))
    unfinished = exists().where(BatchItem.job_id == Job.id, BatchItem.state.in_(UNFINISHED_STATES))
    with catalog.read() as session:
        batch_ids = session.scalars(select(Job.id).where(is_ended, unfinished)).all()
    for batch_id in batch_ids:
        with catalog.write() as session:
            # Unless it was retried or deleted since.
            batch = session.scalar(for_update(select(Job).where(Job.id == batch_id, is_ended)))
            if batch is not None:
                cancel_batch_items(session, batch)


class BatchWorker:
    """Runs batch jobs in slices."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        wakeups: Wakeups,
        settings: Settings,
        name: str,
        metrics: StewardMetrics | None = None,
        ahead_photos: int | None = None,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._settings = settings
        self._ahead_photos = ahead_photos or AHEAD_BATCHES * settings.batch_photos
        self._disk = DiskSpace(settings)
        self._importer = _BatchItemImporter(catalog, store, wakeups, settings)
        metrics = metrics or StewardMetrics(CollectorRegistry())
        self._runner = JobRunner(catalog, settings, name, (JobKind.BATCH,), metrics.count_jobs)

    def run(self, stop: threading.Event) -> None:
        """Run batches until `stop` is set."""
        self._runner.run_jobs(lambda job: self._run_slice(job, stop), stop)

    def run_next(self, stop: threading.Event) -> bool:
        """Run a slice of the next batch; False when there is none."""
        return self._runner.run_next(lambda job: self._run_slice(job, stop))

    def _run_slice(self, job: Job, stop: threading.Event) -> None:
        deadline = time.monotonic() + SLICE_SECONDS
        if not job.params["listed"]:
            self._list_prefix(job)
        elif job.attempts >= MAX_ATTEMPTS:
            self._fail_suspect_item(job)
        try:
            while time.monotonic() < deadline and (items := self._next_items(job)):
                for item in items:
                    if stop.is_set():
                        raise JobInterrupted
                    self._disk.check()
                    self._importer.import_item(job, item)
                    if time.monotonic() > deadline:
                        break
        except StorageFull as error:
            log.warning("batch %s waits for disk space: %s", job.id, error)
            self._finish_slice(job, WaitingFor.DISK_SPACE)
        else:
            self._finish_slice(job)

    def _list_prefix(self, job: Job) -> None:
        """Write the items of a prefix; the gateway writes those of files and keys."""
        with self._catalog.write() as session:
            if leased := lock_leased_job(session, job):
                leased.stage = "list"
        max_photos = self._settings.max_batch_photos
        items, ignored = _list_prefix_photos(self._store, job.params["prefix"], max_photos)
        with self._catalog.write() as session:
            leased = lock_leased_job(session, job)
            if leased is None:
                raise JobInterrupted
            leased.params = {**leased.params, "ignored": ignored}
            add_batch_items(session, leased, items)

    def _fail_suspect_item(self, job: Job) -> None:
        """Fail the next item: several workers died on it, since no photo was imported meanwhile."""
        error = PlacewiseError(
            "worker_crashed",
            f"The steward died {job.attempts} times while it imported this photo. If the photo "
            "is valid, check the steward's log and memory, then upload it again.",
        )
        with self._catalog.read() as session:
            suspects = next_queued_items(session, job.id, 1)
        if not suspects:
            raise error
        log.error("item %d of batch %s crashed its workers", suspects[0].number, job.id)
        self._importer.fail_item(job, suspects[0], error.as_problem())

    def _next_items(self, job: Job) -> list[BatchItem]:
        """Return the next queued items, up to the free capacity of the extractors' queue."""
        with self._catalog.read() as session:
            room = self._ahead_photos - count_queued_photos(session, self._ahead_photos)
            return next_queued_items(session, job.id, min(READ_ITEMS, room)) if room > 0 else []

    def _finish_slice(self, job: Job, waiting_for: WaitingFor | None = None) -> None:
        """Update the progress; complete the batch, or requeue it for its next slice."""
        with self._catalog.write() as session:
            leased = lock_leased_job(session, job)
            if leased is None:
                raise JobInterrupted
            leased.attempts = 0
            counts = sync_item_states(session, leased)
            if counts[JobState.QUEUED]:
                pause = 0.0 if waiting_for else self._pause_seconds(session, leased)
                requeue_job(leased, after_seconds=pause, waiting_for=waiting_for)
                return
            if counts[JobState.RUNNING]:
                leased.stage = "describe"
                requeue_job(leased, after_seconds=PROGRESS_POLL_SECONDS)
                return
            succeed_job(leased, summarise_batch(session, leased, counts))
            update_batch_progress(leased, counts)

    def _pause_seconds(self, session: Session, job: Job) -> float:
        if count_queued_photos(session, self._ahead_photos) == self._ahead_photos:
            return PROGRESS_POLL_SECONDS
        other = select(Job.id).where(claimable_condition((JobKind.BATCH,)), Job.id != job.id)
        return YIELD_SECONDS if session.scalar(select(exists(other))) else 0.0


def _list_prefix_photos(
    store: ObjectStore, prefix: str, max_photos: int
) -> tuple[list[dict[str, Any]], int]:
    """List the photos under a prefix by key, as columns of BatchItem, and count other objects."""
    keys: list[str] = []
    ignored = 0
    for info in store.list(prefix):
        path = PurePosixPath(info.key.removeprefix(prefix))
        hidden = any(part.startswith(".") for part in path.parts)
        if hidden or path.suffix.lower() not in PHOTO_SUFFIXES:
            ignored += 1
            continue
        keys.append(info.key)
        if len(keys) > max_photos:
            raise TooLarge(
                "too_many_photos",
                f"There are more than {max_photos} photos under {prefix} (half of "
                "MAX_QUEUED_JOBS). Use a longer prefix.",
            )
    if not keys:
        raise Unprocessable("no_photos", f"The object store has no photos under {prefix}.")
    return [_object_item(key) for key in sorted(keys)], ignored


def _object_item(key: str) -> dict[str, Any]:
    item: dict[str, Any] = {"name": key, "object_key": key}
    try:
        return {**item, "fields": upload_fields_of_file_name(PurePosixPath(key).name, None)}
    except PlacewiseError as error:
        return {**item, "state": JobState.FAILED, "error": error.as_problem()}
