"""Every object that the catalog names, read and compared with what the catalog knows of it.

The service may run meanwhile: what looks wrong is looked up again, and only what the catalog still
names counts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator

from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import Vocabulary
from shared.chunks import decode_rows
from shared.errors import NotFound
from shared.integrity.check_chunk import verify_chunk
from shared.integrity.named_objects import ObjectKind, ReferencedObject, list_referenced_objects
from shared.integrity.report import FaultKind, IntegrityFault, IntegrityReport
from shared.jobs.table import Job, JobState
from shared.objects import ObjectStore

READ_BLOCK_BYTES = 1024 * 1024

VerifyProgress = Callable[[str, int, int], object]
"""Told what is looked at, how many of them, and of how many."""


def verify_store(
    catalog: Catalog,
    store: ObjectStore,
    *,
    originals: bool,
    progress: VerifyProgress = lambda what, done, total: None,
) -> IntegrityReport:
    """Read every chunk, and with `originals` every photo; of the others, whether they are there.

    Raises Unavailable where catalog or store are away, and SQLAlchemyError as they do.
    """
    report = IntegrityReport()
    with catalog.read() as session:
        named = list(list_referenced_objects(session))
    total = {what: sum(one.what == what for one in named) for what in ObjectKind}
    done: dict[ObjectKind, int] = dict.fromkeys(ObjectKind, 0)
    for one in named:
        faults = list(_verify_object(catalog, store, one, originals, report))
        if faults and _is_still_referenced(catalog, one):
            report.faults += faults
        done[one.what] += 1
        progress(f"{one.what}s", done[one.what], total[one.what])
    with catalog.read() as session:
        report.faults += _find_missing_descriptors(session)
    return report


def _verify_object(
    catalog: Catalog,
    store: ObjectStore,
    one: ReferencedObject,
    originals: bool,
    report: IntegrityReport,
) -> Iterator[IntegrityFault]:
    if one.what == ObjectKind.MANIFEST:
        return  # with its chunk
    if one.what == ObjectKind.CHUNK:
        with catalog.read() as session:
            chunk = session.get(Chunk, one.row_id)
            if chunk is None:
                return
            placed = session.execute(
                select(Descriptor.row, Descriptor.photo_id).where(Descriptor.chunk_id == chunk.id)
            ).all()
        rows = [(row, photo_id) for row, photo_id in placed]
        yield from verify_chunk(
            store, chunk.id, chunk.object_key, chunk.sha256, chunk.rows, rows, report
        )
        return
    if one.what == ObjectKind.MODEL or (one.what == ObjectKind.ORIGINAL and originals):
        yield from _read_whole(store, one, report)
        return
    info = store.head(one.key)
    if info is None:
        yield IntegrityFault(FaultKind.MISSING, one.what, one.key, "it is not in the store")
        return
    report.checked[one.what] += 1
    if one.size_bytes is not None and info.size_bytes != one.size_bytes:
        detail = f"it has {info.size_bytes} bytes, {one.size_bytes} were written"
        yield IntegrityFault(FaultKind.DAMAGED, one.what, one.key, detail)
    elif one.what == ObjectKind.VOCABULARY:
        yield from _read_vocabulary(catalog, store, one, report)


def _read_whole(
    store: ObjectStore, one: ReferencedObject, report: IntegrityReport
) -> Iterator[IntegrityFault]:
    digest = hashlib.sha256()
    try:
        with store.open(one.key) as file:
            while piece := file.read(READ_BLOCK_BYTES):
                digest.update(piece)
                report.read_bytes += len(piece)
    except NotFound:
        yield IntegrityFault(FaultKind.MISSING, one.what, one.key, "it is not in the store")
        return
    report.checked[one.what] += 1
    if digest.hexdigest() != one.sha256:
        yield IntegrityFault(
            FaultKind.DAMAGED, one.what, one.key, f"{one.what} {one.row_id}: its hash differs"
        )


def _read_vocabulary(
    catalog: Catalog, store: ObjectStore, one: ReferencedObject, report: IntegrityReport
) -> Iterator[IntegrityFault]:
    with catalog.read() as session:
        stored = session.get(Vocabulary, one.row_id)
    if stored is None:
        return
    data = store.get(one.key)
    report.read_bytes += len(data)
    try:
        same = hashlib.sha256(decode_rows(data).tobytes()).hexdigest() == stored.sha256
    except (ValueError, KeyError):  # not even its header
        same = False
    if not same:
        yield IntegrityFault(
            FaultKind.DAMAGED, one.what, one.key, "its centres are not those that were stored"
        )


def _is_still_referenced(catalog: Catalog, one: ReferencedObject) -> bool:
    with catalog.read() as session:
        if one.what in (ObjectKind.CHUNK, ObjectKind.MANIFEST):
            chunk = session.get(Chunk, one.row_id)
            return chunk is not None and chunk.superseded_at is None
        if one.what == ObjectKind.ORIGINAL:
            photo = session.get(Photo, one.row_id)
            return photo is not None and photo.deleted_at is None
        return any(now.key == one.key for now in list_referenced_objects(session))


def _find_missing_descriptors(session: Session) -> list[IntegrityFault]:
    """Live photos whose job says that they are searchable, and that are not."""
    there = select(Descriptor.photo_id).where(
        Descriptor.photo_id == Photo.id, Descriptor.generation_id == Generation.id
    )
    found = session.execute(
        select(Photo.id, Generation.id)
        .join(Map, Map.id == Photo.map_id)
        .join(Job, Job.id == Photo.job_id)
        .join(Generation, Generation.map_id == Map.id)
        .where(
            Photo.deleted_at.is_(None),
            Map.deleted_at.is_(None),
            Generation.state == GenerationState.ACTIVE,
            Job.state == JobState.SUCCEEDED,
            ~there.exists(),
        )
    )
    return [
        IntegrityFault(
            FaultKind.NOT_DESCRIBED,
            "photo",
            str(photo_id),
            f"it has no row in generation {generation_id}, which answers",
            photo_id=photo_id,
        )
        for photo_id, generation_id in found
    ]
