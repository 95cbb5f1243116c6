"""Lists the objects that the catalog's rows reference, with their expected size and hash.

Backups must contain these objects, and `placewise storage verify` checks them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.batch_items import BatchItem
from shared.catalog.chunks import Chunk
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import UNFINISHED_STATES, Job, JobKind, JobState
from shared.catalog.maps import Map
from shared.catalog.models import Model
from shared.catalog.photos import Photo, is_kept
from shared.catalog.reconstructions import Reconstruction
from shared.catalog.vocabularies import StoredWhitening, Vocabulary
from shared.storage.chunks import features_key, manifest_key
from shared.storage.keys import ORIGINALS

ROWS_PER_QUERY = 1000


class ObjectKind(StrEnum):
    """What an object is."""

    ORIGINAL = "original"
    CHUNK = "chunk"
    MANIFEST = "manifest"
    FEATURES = "feature file"
    VOCABULARY = "vocabulary"
    WHITENING = "whitening"
    MODEL = "model"
    RECONSTRUCTION = "reconstruction"
    CHECKPOINT = "checkpoint"  # upload of a model that is being added
    FILE = "file"  # of an unfinished batch, not yet a photo


def plural(kind: str) -> str:
    """Return the plural of a kind, for messages."""
    return f"{kind[:-1]}ies" if kind.endswith("y") else f"{kind}s"


@dataclass(frozen=True, slots=True)
class ReferencedObject:
    """An object that a row of the catalog references."""

    key: str
    what: ObjectKind
    row_id: UUID
    """Id of the photo, chunk, vocabulary, whitening, model, reconstruction or job."""
    size_bytes: int | None = None
    """Expected size; None if unknown."""
    sha256: str | None = None
    """Expected SHA-256 of the object's bytes, hexadecimal; None if unknown."""


def list_referenced_objects(session: Session) -> Iterator[ReferencedObject]:
    """Iterate over the objects of photos (in the trash, too), models, reconstructions, unfinished
    jobs and the generations that are active or being built, of maps that are not deleted."""
    photos = select(Photo.id, Photo.object_key, Photo.size_bytes, Photo.sha256).join(
        Map, Map.id == Photo.map_id
    )
    photos = photos.where(is_kept(), Map.deleted_at.is_(None))
    for row in session.execute(photos.execution_options(yield_per=ROWS_PER_QUERY)):
        yield ReferencedObject(
            row.object_key, ObjectKind.ORIGINAL, row.id, row.size_bytes, row.sha256
        )
    chunks = (
        select(Chunk)
        .join(Generation, Generation.id == Chunk.generation_id)
        .join(Map, Map.id == Generation.map_id)
        .where(
            Chunk.superseded_at.is_(None),
            Generation.state.in_((GenerationState.ACTIVE, GenerationState.BUILDING)),
            Map.deleted_at.is_(None),
        )
    )
    for chunk in session.scalars(chunks.execution_options(yield_per=ROWS_PER_QUERY)):
        key = chunk.object_key
        yield ReferencedObject(key, ObjectKind.CHUNK, chunk.id, chunk.size_bytes, chunk.sha256)
        yield ReferencedObject(manifest_key(key), ObjectKind.MANIFEST, chunk.id)
        if chunk.features_model is not None:
            yield ReferencedObject(
                features_key(key),
                ObjectKind.FEATURES,
                chunk.id,
                chunk.features_bytes,
                chunk.features_sha256,
            )
    for table, what in (
        (Vocabulary, ObjectKind.VOCABULARY),
        (StoredWhitening, ObjectKind.WHITENING),
    ):
        # Their stored hashes are of the array's numbers, not of the object's bytes.
        objects = select(table.id, table.object_key).join(Map, Map.id == table.map_id)
        for stored in session.execute(objects.where(Map.deleted_at.is_(None))):
            yield ReferencedObject(stored.object_key, what, stored.id)
    models = select(Model.id, Model.object_key, Model.size_bytes, Model.sha256)
    for model in session.execute(models.where(Model.object_key.is_not(None))):
        yield ReferencedObject(
            model.object_key, ObjectKind.MODEL, model.id, model.size_bytes, model.sha256
        )
    reconstructions = select(Reconstruction).join(Map, Map.id == Reconstruction.map_id)
    for made in session.scalars(reconstructions.where(Map.deleted_at.is_(None))):
        for component in made.list_components():
            for key, sha256 in component.sha256.items():
                yield ReferencedObject(key, ObjectKind.RECONSTRUCTION, made.id, sha256=sha256)
    jobs = select(Job.id, Job.params).where(
        Job.kind == JobKind.ADD_MODEL, Job.state.in_(UNFINISHED_STATES)
    )
    for job in session.execute(jobs).all():
        yield ReferencedObject(job.params["object_key"], ObjectKind.CHECKPOINT, job.id)
    files = select(BatchItem.object_key, BatchItem.job_id).where(
        BatchItem.state == JobState.QUEUED, BatchItem.object_key.startswith(ORIGINALS)
    )
    for item in session.execute(files.execution_options(yield_per=ROWS_PER_QUERY)):
        yield ReferencedObject(item.object_key, ObjectKind.FILE, item.job_id)
