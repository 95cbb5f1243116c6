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
from shared.integrity.check_chunk import check_chunk
from shared.integrity.named_objects import NamedObject, What, named_objects
from shared.integrity.report import Fault, Report, Wrong
from shared.jobs.table import Job, JobState
from shared.objects import ObjectStore

PIECE_BYTES = 1024 * 1024

Progress = Callable[[str, int, int], object]
"""Told what is looked at, how many of them, and of how many."""


def check(
    catalog: Catalog,
    store: ObjectStore,
    *,
    originals: bool,
    progress: Progress = lambda what, done, total: None,
) -> Report:
    """Read every chunk, and with `originals` every photo; of the others, whether they are there.

    Raises Unavailable where catalog or store are away, and SQLAlchemyError as they do.
    """
    report = Report()
    with catalog.read() as session:
        named = list(named_objects(session))
    total = {what: sum(one.what == what for one in named) for what in What}
    done: dict[What, int] = dict.fromkeys(What, 0)
    for one in named:
        faults = list(_look(catalog, store, one, originals, report))
        if faults and _still_named(catalog, one):
            report.faults += faults
        done[one.what] += 1
        progress(f"{one.what}s", done[one.what], total[one.what])
    with catalog.read() as session:
        report.faults += _not_described(session)
    return report


def _look(
    catalog: Catalog, store: ObjectStore, one: NamedObject, originals: bool, report: Report
) -> Iterator[Fault]:
    if one.what == What.MANIFEST:
        return  # with its chunk
    if one.what == What.CHUNK:
        with catalog.read() as session:
            chunk = session.get(Chunk, one.row_id)
            if chunk is None:
                return
            placed = session.execute(
                select(Descriptor.row, Descriptor.photo_id).where(Descriptor.chunk_id == chunk.id)
            ).all()
        rows = [(row, photo_id) for row, photo_id in placed]
        yield from check_chunk(
            store, chunk.id, chunk.object_key, chunk.sha256, chunk.rows, rows, report
        )
        return
    if one.what == What.MODEL or (one.what == What.ORIGINAL and originals):
        yield from _read_whole(store, one, report)
        return
    info = store.head(one.key)
    if info is None:
        yield Fault(Wrong.MISSING, one.what, one.key, "it is not in the store")
        return
    report.checked[one.what] += 1
    if one.size_bytes is not None and info.size_bytes != one.size_bytes:
        detail = f"it has {info.size_bytes} bytes, {one.size_bytes} were written"
        yield Fault(Wrong.DAMAGED, one.what, one.key, detail)
    elif one.what == What.VOCABULARY:
        yield from _read_vocabulary(catalog, store, one, report)


def _read_whole(store: ObjectStore, one: NamedObject, report: Report) -> Iterator[Fault]:
    digest = hashlib.sha256()
    try:
        with store.open(one.key) as file:
            while piece := file.read(PIECE_BYTES):
                digest.update(piece)
                report.read_bytes += len(piece)
    except NotFound:
        yield Fault(Wrong.MISSING, one.what, one.key, "it is not in the store")
        return
    report.checked[one.what] += 1
    if digest.hexdigest() != one.sha256:
        yield Fault(Wrong.DAMAGED, one.what, one.key, f"{one.what} {one.row_id}: its hash differs")


def _read_vocabulary(
    catalog: Catalog, store: ObjectStore, one: NamedObject, report: Report
) -> Iterator[Fault]:
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
        yield Fault(Wrong.DAMAGED, one.what, one.key, "its centres are not those that were stored")


def _still_named(catalog: Catalog, one: NamedObject) -> bool:
    with catalog.read() as session:
        if one.what in (What.CHUNK, What.MANIFEST):
            chunk = session.get(Chunk, one.row_id)
            return chunk is not None and chunk.superseded_at is None
        if one.what == What.ORIGINAL:
            photo = session.get(Photo, one.row_id)
            return photo is not None and photo.deleted_at is None
        return any(now.key == one.key for now in named_objects(session))


def _not_described(session: Session) -> list[Fault]:
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
        Fault(
            Wrong.NOT_DESCRIBED,
            "photo",
            str(photo_id),
            f"it has no row in generation {generation_id}, which answers",
            photo_id=photo_id,
        )
        for photo_id, generation_id in found
    ]
