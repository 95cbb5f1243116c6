"""What is true after a fault, counted in the catalog and in the store."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from uuid import UUID

from sqlalchemy import ColumnElement, func, select

from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.photos import Photo
from shared.catalog.session import Catalog
from shared.chunks import manifest_key
from shared.errors import NotFound
from shared.jobs import Job
from shared.jobs.table import UNFINISHED_STATES, JobKind, JobState
from shared.objects import ObjectStore


@dataclass(slots=True)
class InvariantViolations:
    """All of it has to be zero."""

    lost: int = 0
    """Acknowledged photos that the catalog or the store does not have, or that have no row."""
    twice: int = 0
    """Photos with more than one row in the active generation, or stored twice."""
    stuck: int = 0
    """Jobs that have not ended."""
    failed: int = 0
    """Jobs that ended with an error, although nothing is wrong with any photo."""
    torn: int = 0
    """Live chunks whose bytes or manifest are not what the catalog says."""
    details: list[str] = field(default_factory=list)

    @property
    def none_found(self) -> bool:
        return not (self.lost or self.twice or self.stuck or self.failed or self.torn)


def count_unfinished_jobs(catalog: Catalog, *, photos: bool = False) -> int:
    """Jobs that have not ended yet; `photos`: without those of questions."""
    wanted: list[ColumnElement[bool]] = [Job.state.in_(UNFINISHED_STATES)]
    if photos:
        wanted.append(Job.kind != JobKind.DESCRIBE)
    with catalog.read() as session:
        return session.scalar(select(func.count()).select_from(Job).where(*wanted)) or 0


def check_invariants(
    catalog: Catalog, store: ObjectStore, acknowledged: Mapping[str, UUID]
) -> InvariantViolations:
    """Count; `acknowledged` gives the photo's id for the sha256 of each photo that was taken."""
    counts = InvariantViolations()
    with catalog.read() as session:
        photos = {
            photo.id: photo
            for photo in session.scalars(select(Photo).where(Photo.deleted_at.is_(None)))
        }
        rows = Counter(
            session.scalars(
                select(Descriptor.photo_id)
                .join(Generation, Generation.id == Descriptor.generation_id)
                .where(Generation.state == GenerationState.ACTIVE)
            )
        )
        chunks = session.scalars(select(Chunk).where(Chunk.superseded_at.is_(None))).all()
        failed = session.scalars(select(Job).where(Job.state == JobState.FAILED)).all()
    counts.stuck = count_unfinished_jobs(catalog)
    counts.failed = len(failed)
    counts.details += [f"the job {job.id} ({job.kind}) failed: {job.error}" for job in failed]
    stored = {info.key for info in store.list("originals/")}
    for sha256, photo_id in acknowledged.items():
        photo = photos.get(photo_id)
        if photo is None or photo.sha256 != sha256:
            counts.details.append(f"{photo_id} was acknowledged, and the catalog has no such photo")
        elif photo.object_key not in stored:
            counts.details.append(f"{photo_id} was acknowledged, and its bytes are gone")
        elif not rows[photo_id]:
            counts.details.append(f"{photo_id} was acknowledged, and has no descriptor")
        else:
            continue
        counts.lost += 1
    by_bytes = Counter(photo.sha256 for photo in photos.values())
    several = [sha256 for sha256, times in by_bytes.items() if times > 1]
    doubled = [photo_id for photo_id, times in rows.items() if times > 1]
    counts.twice = len(several) + len(doubled)
    counts.details += [f"{sha256} is stored {by_bytes[sha256]} times" for sha256 in several]
    counts.details += [f"{photo_id} has {rows[photo_id]} rows" for photo_id in doubled]
    for chunk in chunks:
        if not _is_intact(store, chunk):
            counts.torn += 1
            counts.details.append(f"the chunk {chunk.object_key} is not what the catalog says")
    return counts


def _is_intact(store: ObjectStore, chunk: Chunk) -> bool:
    try:
        data, manifest = store.get(chunk.object_key), store.get(manifest_key(chunk.object_key))
    except NotFound:
        return False
    return hashlib.sha256(data).hexdigest() == chunk.sha256 and chunk.sha256.encode() in manifest
