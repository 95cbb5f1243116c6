"""One map with its catalog, its store and an extractor: what the integration tests work in."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

import numpy as np
import torch
from sqlalchemy import select

from services.extractor.worker import ExtractorWorker
from services.steward.tasks.auto_fit import fit_due_vocabularies
from services.steward.tasks.model_changes import advance_model_changes
from services.steward.tasks.reindex_jobs import QueuedChunks
from shared.catalog.chunks import count_searchable
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, active_generation
from shared.catalog.jobs import UNFINISHED_STATES, get_job
from shared.catalog.photos import Photo
from shared.catalog.vocabularies import Vocabulary
from shared.config.settings import Settings
from shared.descriptors.extractor import Extractor
from shared.descriptors.vocabulary import ClusterCentres
from shared.extractor_config.configs import get_extractor_config
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import Pixels, get_preprocessing
from shared.jobs import InProcessWakeups, Job, JobKind, JobState
from shared.jobs.model_changes import cancel_model_change, start_model_change
from shared.storage import FolderStore
from shared.storage.chunks import Rows
from shared.storage.keys import TRASH
from tests.support.catalog_rows import ask, delete, read_job, stored_rows, upload
from tests.support.photos import photo_bytes

ROUNDS = 60  # of draining and stewarding, before a model change that does not end is a failure
WAIT_SECONDS = 90.0
FIT = {"clusters": 8, "sample": 100, "seed": 0}


@dataclass(slots=True)
class Harness:
    catalog: Catalog
    store: FolderStore
    settings: Settings
    map_id: UUID
    make_worker: Callable[[], ExtractorWorker]
    wakeups: InProcessWakeups = field(default_factory=InProcessWakeups)
    _worker: ExtractorWorker | None = None
    _queued_chunks: QueuedChunks = field(default_factory=dict)

    # --- what clients do ---

    def upload(self, *numbers: int) -> list[UUID]:
        """Store the photos of these numbers; their ids."""
        return [self.upload_bytes(photo_bytes(number))[0] for number in numbers]

    def upload_bytes(self, data: bytes) -> tuple[UUID, UUID]:
        """Store a photo; its id and its job's."""
        return upload(self.catalog, self.store, self.map_id, data)

    def ask(self, data: bytes) -> UUID:
        return ask(self.catalog, self.store, self.map_id, data)

    def delete(self, photo_id: UUID) -> None:
        delete(self.catalog, self.map_id, photo_id)

    def start(self, kind: JobKind, **params: Any) -> UUID:
        """Begin a model change; its job."""
        with self.catalog.write() as session:
            return start_model_change(session, self.map_id, kind, params).id

    def fit_if_due(self) -> list[UUID]:
        """The steward's look for maps to fit a vocabulary for; the map's fits, oldest first."""
        fit_due_vocabularies(self.catalog, self.wakeups)
        with self.catalog.read() as session:
            fits = select(Job.id).where(Job.kind == JobKind.FIT, Job.map_id == self.map_id)
            return list(session.scalars(fits.order_by(Job.id)))

    def cancel(self, job_id: UUID) -> None:
        """Cancel a model change."""
        with self.catalog.write() as session:
            cancel_model_change(session, get_job(session, self.map_id, job_id, lock=True))

    # --- what the services do ---

    @property
    def worker(self) -> ExtractorWorker:
        if self._worker is None:
            self._worker = self.make_worker()
        return self._worker

    def drain(self) -> bool:
        """Do all jobs of the extractor, fits too; the result is that of the first drain."""
        stop = threading.Event()
        result = self.worker.drain(stop)
        while self.worker.fits.run_next(stop):
            self.worker.drain(stop)
        return result

    def ended(self) -> tuple[int, int]:
        """How many jobs have succeeded, and how many have failed."""
        with self.catalog.read() as session:
            states = session.scalars(select(Job.state)).all()
        return states.count(JobState.SUCCEEDED), states.count(JobState.FAILED)

    def advance(self) -> None:
        advance_model_changes(self.catalog, self.wakeups, self._queued_chunks)

    def finish(self, job_id: UUID, each_round: Callable[[], None] = lambda: None) -> Job:
        """Drain and steward until the job has ended; the job."""
        for _ in range(ROUNDS):
            self.drain()
            each_round()
            self.advance()
            each_round()
            job = read_job(self.catalog, job_id)
            if job.state not in UNFINISHED_STATES:
                return job
        raise AssertionError(f"the job did not end: {job.state}, {job.stage}, {job.waiting_for}")

    def fit(self, **params: Any) -> Job:
        """A fit from its start to its end."""
        return self.finish(self.start(JobKind.FIT, **{**FIT, **params}))

    def build(self, **params: Any) -> tuple[UUID, UUID]:
        """A fit up to where its generation waits for descriptors; the job and the generation."""
        job_id = self.start(JobKind.FIT, **{**FIT, **params})
        self.drain()
        building = self.building()
        assert building is not None
        return job_id, building.id

    # --- what can be seen ---

    def await_end(self, job_id: UUID) -> JobState:
        """The state in which the job ends, while another thread works on it."""
        deadline = time.monotonic() + WAIT_SECONDS
        while (job := self.job(job_id)).state in UNFINISHED_STATES:
            assert time.monotonic() < deadline, f"the job did not end: {job.state}, {job.stage}"
            time.sleep(0.01)
        return JobState(job.state)

    def job(self, job_id: UUID) -> Job:
        return read_job(self.catalog, job_id)

    def job_of(self, photo_id: UUID) -> Job:
        """The job that the photo names."""
        with self.catalog.read() as session:
            job_id = session.get_one(Photo, photo_id).job_id
        assert job_id is not None
        return self.job(job_id)

    def active(self) -> Generation:
        with self.catalog.read() as session:
            found = active_generation(session, self.map_id)
        assert found is not None
        return found

    def building(self) -> Generation | None:
        with self.catalog.read() as session:
            return session.scalar(
                select(Generation).where(
                    Generation.map_id == self.map_id,
                    Generation.state == GenerationState.BUILDING,
                )
            )

    def generation(self, generation_id: UUID) -> Generation:
        with self.catalog.read() as session:
            return session.get_one(Generation, generation_id)

    def searchable(self) -> int:
        """How many live photos the active generation finds."""
        with self.catalog.read() as session:
            return count_searchable(session, self.active().id)

    def rows(self, generation_id: UUID | None = None) -> dict[UUID, Rows]:
        """The stored descriptor of each photo, of the active generation if none is named."""
        return stored_rows(self.catalog, self.store, generation_id or self.active().id)

    def reindex_jobs(self, generation_id: UUID) -> list[Job]:
        with self.catalog.read() as session:
            return list(
                session.scalars(
                    select(Job)
                    .where(Job.kind == JobKind.REINDEX, Job.generation_id == generation_id)
                    .order_by(Job.id)
                )
            )

    def vocabulary(self, vocabulary_id: UUID | str | None) -> Vocabulary:
        with self.catalog.read() as session:
            return session.get_one(Vocabulary, UUID(str(vocabulary_id)))

    def keys(self, prefix: str) -> set[str]:
        return {
            info.key for info in self.store.list(prefix) if prefix or not info.key.startswith(TRASH)
        }


def expected_row(extractor: str, data: bytes, centres: ClusterCentres | None = None) -> Rows:
    """What the extractor makes of the photo, without any of the services."""
    made = Extractor(
        get_extractor_config(extractor, allow_test_extractors=True), torch.device("cpu")
    )
    pixels = decode_photo(data, made.preprocessing, 10**9).pixels
    row: Rows = made.describe([pixels], centres)[0]
    return row


def same(one: Rows, other: Rows) -> bool:
    """The same descriptor, but for the order in which floats were summed."""
    return bool(np.allclose(one, other, atol=1e-5))


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
