"""Helpers of the tests of model changes."""

from __future__ import annotations

import io
import itertools
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import select

from services.extractor import checkpointed_steps
from services.extractor.model_changes import ModelChangeRunner
from services.extractor.worker import ExtractorWorker
from shared.catalog.photos import Photo
from shared.jobs import Job, JobKind
from shared.storage.keys import new_vocabulary_key
from tests.integration.workplace import Workplace

PHOTOS = 6
WIDTH = 16  # of the tiny backbone's local features


def import_file(workplace: Workplace, data: bytes, name: str = "centres.npy") -> UUID:
    """Begin the import of a vocabulary file; its job."""
    key = new_vocabulary_key()
    workplace.store.put(key, data)
    return workplace.start(JobKind.IMPORT, object_key=key, filename=name)


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def some_centres(clusters: int, seed: int = 3) -> NDArray[np.float32]:
    return np.random.default_rng(seed).standard_normal((clusters, WIDTH)).astype(np.float32)


def photo_ids(workplace: Workplace) -> list[UUID]:
    """The map's live photos, oldest first."""
    with workplace.catalog.read() as session:
        return list(
            session.scalars(
                select(Photo.id)
                .where(Photo.map_id == workplace.map_id, Photo.deleted_at.is_(None))
                .order_by(Photo.id)
            )
        )


def do_one_step_a_slice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each look at the clock is a slice later than the one before."""
    looks = itertools.count()
    clock = SimpleNamespace(monotonic=lambda: next(looks) * checkpointed_steps.STEP_SECONDS)
    monkeypatch.setattr(checkpointed_steps, "time", clock)


def do_slices(
    monkeypatch: pytest.MonkeyPatch,
    worker: ExtractorWorker,
    until: Callable[[Job], bool] = lambda job: True,
) -> None:
    """Drain until after the slice of a job (as it was claimed) for which `until` is true."""
    stop = threading.Event()
    real = ModelChangeRunner.run_step

    def slice_and_stop(self: ModelChangeRunner, job: Job) -> None:
        real(self, job)
        if until(job):
            stop.set()

    with monkeypatch.context() as patched:
        patched.setattr(ModelChangeRunner, "run_step", slice_and_stop)
        worker.drain(stop)
