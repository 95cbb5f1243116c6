"""One photo of a batch, by the path of an upload: its bytes into the store, its checks, its row.

The photo's row, its job's and the item's are one transaction, under the batch's lease. What is
refused leaves no bytes; what a kill leaves is an orphan that no row knows.
"""

from __future__ import annotations

import contextlib
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any
from uuid import UUID

from sqlalchemy.orm import Session

from services.steward.archives import Archive, ArchiveLimits, open_archive
from services.steward.batches.list_archive import member_from_location
from services.steward.take import JobInterrupted
from shared.catalog.session import Catalog
from shared.errors import InvalidRequest, PlacewiseError, Unavailable
from shared.intake.incoming import ValidatedPhoto, validate_photo
from shared.intake.photo_quota import PhotoQuota
from shared.intake.received import StoredUpload, StreamValidator, base_name, check_photo_signature
from shared.intake.store_photo import StoreResult, insert_photo, retry_on_conflict
from shared.jobs import Job, JobState, Priority, Wakeups
from shared.jobs.batches import BatchItem, BatchSource
from shared.jobs.leases import get_lease_token, lock_leased_jobs
from shared.objects import ObjectStore
from shared.objects.keys import new_original_key
from shared.photo_formats import PHOTO_SIGNATURE_BYTES
from shared.settings import Settings

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
        return self._quota.place(key_id, job.params["max_photos"])

    def _received_upload(self, item: BatchItem) -> StoredUpload:
        """The file that the gateway has stored."""
        assert item.object_key is not None
        return StoredUpload(
            key=item.object_key,
            filename=base_name(item.name),
            size_bytes=item.source["size_bytes"],
            sha256=item.source["sha256"],
            begin=self._store.read_range(item.object_key, 0, PHOTO_SIGNATURE_BYTES),
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
            begin=file.begin,
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
