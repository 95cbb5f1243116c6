"""What a look at the whole store has found.

One chunk against its hash, its manifest and the catalog's rows.

Every object that the catalog names, read and compared with what the catalog knows of it.

The service may run meanwhile: what looks wrong is looked up again, and only what the catalog still
names counts.

Describing photos again whose descriptors are lost. Their originals are all that it needs.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from uuid import UUID

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from shared.catalog.base import db_now
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.generations import Generation, GenerationState, lock_generation
from shared.catalog.jobs import UNFINISHED_STATES, Job, JobKind, JobState, Priority
from shared.catalog.maps import Map, increment_map_version, lock_map
from shared.catalog.photos import Photo, get_live_photos
from shared.catalog.session import Catalog
from shared.catalog.vocabularies import Vocabulary
from shared.errors import NotFound
from shared.ids import new_id
from shared.integrity.referenced_objects import (
    ObjectKind,
    ReferencedObject,
    list_referenced_objects,
)
from shared.jobs.transitions import requeue_job
from shared.jobs.wakeups import Wakeups
from shared.storage import ObjectStore
from shared.storage.chunks import decode_rows, manifest_key, rows_are_valid


class FaultKind(StrEnum):
    MISSING = "missing"  # the catalog names an object that is not there
    DAMAGED = "damaged"  # its bytes are not those that were written
    DIFFERENT = "different"  # the catalog says something else of it than it does itself
    NOT_DESCRIBED = "not_described"  # the job succeeded, and no descriptor is there


@dataclass(frozen=True, slots=True)
class IntegrityFault:
    wrong: FaultKind
    what: str
    """`original`, `chunk`, `manifest`, ..., or `photo`."""
    name: str
    """The object's key, or the photo's id."""
    detail: str
    chunk_id: UUID | None = None
    """The chunk that it makes useless."""
    photo_id: UUID | None = None
    """The photo that has to be described again."""


@dataclass(slots=True)
class IntegrityReport:
    checked: Counter[str] = field(default_factory=Counter)
    """By what they are."""
    read_bytes: int = 0
    faults: list[IntegrityFault] = field(default_factory=list)
    orphans: int = 0
    """Objects that no row knows. The steward moves them to the trash when they are old enough."""
    orphan_bytes: int = 0
    trash_objects: int = 0
    trash_bytes: int = 0


def verify_chunk(
    store: ObjectStore,
    chunk_id: UUID,
    object_key: str,
    sha256: str,
    rows: int,
    catalog_rows: list[tuple[int, UUID]],
    report: IntegrityReport,
) -> Iterator[IntegrityFault]:
    """What is wrong with the chunk; `catalog_rows` is the row of each of its photos by the
    catalog."""
    manifest = manifest_key(object_key)
    try:
        data = store.get(object_key)
    except NotFound:
        yield IntegrityFault(
            FaultKind.MISSING, "chunk", object_key, "it is not in the store", chunk_id
        )
        return
    report.checked["chunk"] += 1
    report.read_bytes += len(data)
    if hashlib.sha256(data).hexdigest() != sha256:
        yield IntegrityFault(FaultKind.DAMAGED, "chunk", object_key, "its hash differs", chunk_id)
        return
    found = decode_rows(data)
    if len(found) != rows or not rows_are_valid(found).all():
        detail = f"it has {len(found)} rows of {rows}, or rows that are no unit vectors"
        yield IntegrityFault(FaultKind.DIFFERENT, "chunk", object_key, detail, chunk_id)
        return
    try:
        said = json.loads(store.get(manifest))
        photo_ids = [UUID(photo_id) for photo_id in said["photo_ids"]]
        fits = said["sha256"] == sha256 and len(photo_ids) == rows
    except NotFound:
        yield IntegrityFault(
            FaultKind.MISSING, "manifest", manifest, "it is not in the store", chunk_id
        )
        return
    except (ValueError, KeyError, TypeError, AttributeError):
        yield IntegrityFault(FaultKind.DAMAGED, "manifest", manifest, "it can't be read", chunk_id)
        return
    report.checked["manifest"] += 1
    if not fits:
        yield IntegrityFault(
            FaultKind.DIFFERENT, "manifest", manifest, "it is of another chunk", chunk_id
        )
        return
    astray = [
        photo_id
        for row, photo_id in catalog_rows
        if not 0 <= row < rows or photo_ids[row] != photo_id
    ]
    if astray:
        detail = f"{len(astray)} photos have another row by the catalog, the first is {astray[0]}"
        yield IntegrityFault(FaultKind.DIFFERENT, "chunk", object_key, detail, chunk_id)


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


def repair_descriptors(catalog: Catalog, hints: Wakeups, report: IntegrityReport) -> int:
    """Queue the photos of damaged chunks, and those without a descriptor; how many.

    The chunks' rows leave the catalog in the same transaction: until a photo is described again, it
    is not found, and nothing wrong is.
    """
    queued = 0
    for chunk_id in dict.fromkeys(f.chunk_id for f in report.faults if f.chunk_id is not None):
        queued += catalog.run(partial(give_up_chunk, chunk_id=chunk_id))
    lost = [fault.photo_id for fault in report.faults if fault.photo_id is not None]
    if lost:
        queued += catalog.run(lambda session: _queue_photos(session, lost))
    if queued:
        hints.send()
    return queued


def give_up_chunk(session: Session, chunk_id: UUID) -> int:
    """Let the chunk's photos be described again, and its rows leave the catalog; how many."""
    chunk = session.get(Chunk, chunk_id)
    if chunk is None or chunk.superseded_at is not None:
        return 0  # merged or mended meanwhile
    generation = lock_generation(session, chunk.generation_id)
    lock_map(session, generation.map_id)
    photo_ids = list(
        session.scalars(select(Descriptor.photo_id).where(Descriptor.chunk_id == chunk_id))
    )
    session.execute(delete(Descriptor).where(Descriptor.chunk_id == chunk_id))
    chunk.superseded_at = db_now()
    increment_map_version(session, generation.map_id)
    if generation.state == GenerationState.ACTIVE:
        return _queue_photos(session, photo_ids)
    # Of one that is being built: the steward queues what has neither a row nor a job there.
    session.execute(
        delete(Job).where(
            Job.kind == JobKind.REINDEX,
            Job.generation_id == generation.id,
            Job.photo_id.in_(photo_ids),
        )
    )
    return len(photo_ids)


def _queue_photos(session: Session, photo_ids: list[UUID]) -> int:
    live = get_live_photos(session, photo_ids)
    for photo in live.values():
        _queue_photo(session, photo)
    return len(live)


def _queue_photo(session: Session, photo: Photo) -> None:
    job = session.get(Job, photo.job_id, with_for_update=True) if photo.job_id else None
    if job is not None and job.state in UNFINISHED_STATES:
        return
    if job is not None:
        requeue_job(job)
        return
    photo.job_id = new_id()
    session.add(
        Job(
            id=photo.job_id,
            map_id=photo.map_id,
            kind=JobKind.INDEX,
            priority=Priority.UPLOAD,
            photo_id=photo.id,
        )
    )
