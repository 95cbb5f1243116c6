"""Invariants of a deployment after faults: nothing is lost, doubled, stuck, failed or torn."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping
from uuid import UUID

from sqlalchemy import ColumnElement, func, select

from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import UNFINISHED_STATES, JobKind, JobState
from shared.catalog.photos import Photo
from shared.errors import NotFound
from shared.jobs import Job
from shared.storage import ObjectStore
from shared.storage.chunks import manifest_key


def count_unfinished_jobs(catalog: Catalog, *, photos: bool = False) -> int:
    """Count unfinished jobs; with `photos`, without the jobs of queries."""
    conditions: list[ColumnElement[bool]] = [Job.state.in_(UNFINISHED_STATES)]
    if photos:
        conditions.append(Job.kind != JobKind.DESCRIBE)
    with catalog.read() as session:
        return session.scalar(select(func.count()).select_from(Job).where(*conditions)) or 0


def find_violations(
    catalog: Catalog, store: ObjectStore, acknowledged: Mapping[str, UUID]
) -> list[str]:
    """Return what is wrong; `acknowledged` maps the sha256 of each acknowledged photo to its id."""
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
        jobs = session.scalars(select(Job).where(Job.state != JobState.SUCCEEDED)).all()
    stored = {info.key for info in store.list("originals/")}
    by_sha256 = Counter(photo.sha256 for photo in photos.values())
    found = [f"the job {job.id} ({job.kind}) is {job.state}: {job.error}" for job in jobs]
    for sha256, photo_id in acknowledged.items():
        photo = photos.get(photo_id)
        if photo is None or photo.sha256 != sha256:
            found.append(f"acknowledged photo {photo_id} is not in the catalog")
        elif photo.object_key not in stored:
            found.append(f"acknowledged photo {photo_id} is not in the object store")
        elif not rows[photo_id]:
            found.append(f"acknowledged photo {photo_id} has no descriptor")
    found += [f"{sha256} is stored {n} times" for sha256, n in by_sha256.items() if n > 1]
    found += [f"{photo_id} has {n} rows" for photo_id, n in rows.items() if n > 1]
    return found + [
        f"chunk {chunk.object_key} does not match its hash in the catalog"
        for chunk in chunks
        if not _is_intact(store, chunk)
    ]


def _is_intact(store: ObjectStore, chunk: Chunk) -> bool:
    try:
        data, manifest = store.get(chunk.object_key), store.get(manifest_key(chunk.object_key))
    except NotFound:
        return False
    return hashlib.sha256(data).hexdigest() == chunk.sha256 and chunk.sha256.encode() in manifest
