"""Helpers of the tests of model changes."""

from __future__ import annotations

import io
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select

from shared.catalog.photos import Photo
from shared.jobs import JobKind
from shared.storage.keys import new_vocabulary_key
from tests.integration.harness import Harness

PHOTOS = 6
WIDTH = 16  # of the tiny backbone's local features


def import_file(harness: Harness, data: bytes, name: str = "centres.npy") -> UUID:
    """Begin the import of a vocabulary file; its job."""
    key = new_vocabulary_key()
    harness.store.put(key, data)
    return harness.start(JobKind.IMPORT, object_key=key, filename=name)


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def some_centres(clusters: int) -> NDArray[np.float32]:
    return np.random.default_rng(3).standard_normal((clusters, WIDTH)).astype(np.float32)


def photo_ids(harness: Harness) -> list[UUID]:
    """The map's live photos, oldest first."""
    with harness.catalog.read() as session:
        return list(
            session.scalars(
                select(Photo.id)
                .where(Photo.map_id == harness.map_id, Photo.deleted_at.is_(None))
                .order_by(Photo.id)
            )
        )
