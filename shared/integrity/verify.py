"""Verification of the object store against the catalog, and repair of lost descriptors.

`verify_store` reads every object that the catalog references and compares it with size and hash in
the catalog. The service may run meanwhile: a fault only counts if the catalog still references the
object afterwards. `repair_descriptors` queues the photos of damaged chunks again, which only needs
their originals, and gives up damaged local features.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from uuid import UUID

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.base import db_now
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, lock_generation
from shared.catalog.jobs import UNFINISHED_STATES, Job, JobKind, JobState
from shared.catalog.maps import Map, increment_map_version, lock_map
from shared.catalog.photos import Photo, get_live_photos
from shared.catalog.vocabularies import Vocabulary
from shared.errors import NotFound
from shared.ids import new_id
from shared.integrity.referenced_objects import (
    ObjectKind,
    ReferencedObject,
    list_referenced_objects,
    plural,
)
from shared.jobs.transitions import requeue_job_as_new
from shared.jobs.wakeups import Wakeups
from shared.storage import ObjectStore
from shared.storage.chunks import decode_rows, manifest_key, read_manifest, rows_are_valid
from shared.storage.copying import hash_object
from shared.storage.keys import object_not_found_error


class FaultKind(StrEnum):
    """What is wrong with an object or a photo."""

    MISSING = "missing"  # the catalog references an object that does not exist
    DAMAGED = "damaged"  # its bytes are not those that were written
    DIFFERENT = "different"  # its content contradicts the catalog
    NOT_DESCRIBED = "not_described"  # the job succeeded, but the photo has no descriptor


@dataclass(frozen=True, slots=True)
class IntegrityFault:
    """One fault, and what has to be repaired."""

    wrong: FaultKind
    what: str
    """`original`, `chunk`, `manifest`, ..., or `photo`."""
    name: str
    """The object's key, or the photo's id."""
    detail: str
    chunk_id: UUID | None = None
    """The chunk that is unusable, or whose feature file is."""
    photo_id: UUID | None = None
    """The photo whose descriptor has to be computed again."""


@dataclass(slots=True)
class IntegrityReport:
    """Result of a verification."""

    checked: Counter[str] = field(default_factory=Counter)
    """Number of checked objects by kind."""
    read_bytes: int = 0
    faults: list[IntegrityFault] = field(default_factory=list)
    orphans: int = 0
    """Objects that no row references. The steward moves old ones to the trash."""
    orphan_bytes: int = 0
    trash_objects: int = 0
    trash_bytes: int = 0


VerifyProgress = Callable[[str, int, int], object]
"""Progress callback: kind of objects, number done, total."""


def verify_store(
    catalog: Catalog,
    store: ObjectStore,
    *,
    originals: bool,
    progress: VerifyProgress = lambda what, done, total: None,
) -> IntegrityReport:
    """Verify every referenced object, and that every described photo has a descriptor.

    Args:
        originals: read every original photo and verify its hash, instead of only its size.

    Raises:
        Unavailable: the catalog or the store is unavailable.
        SQLAlchemyError: as the catalog does.
    """
    verifier = _Verifier(catalog, store, originals=originals)
    with catalog.read() as session:
        referenced = list(list_referenced_objects(session))
    total, done = Counter(one.what for one in referenced), Counter[ObjectKind]()
    faults: list[IntegrityFault] = []
    for one in referenced:
        if one.what != ObjectKind.MANIFEST:  # verified with its chunk
            faults += filter(None, [verifier.verify(one)])
        done[one.what] += 1
        progress(plural(one.what), done[one.what], total[one.what])
    with catalog.read() as session:
        present = {one.key for one in list_referenced_objects(session)} if faults else set()
        verifier.report.faults = [
            *(fault for fault in faults if fault.name in present),
            *_find_missing_descriptors(session),
        ]
    return verifier.report


class _Verifier:
    def __init__(self, catalog: Catalog, store: ObjectStore, *, originals: bool) -> None:
        self._catalog = catalog
        self._store = store
        self._read_kinds = {ObjectKind.MODEL, ObjectKind.FEATURES, ObjectKind.RECONSTRUCTION}
        if originals:
            self._read_kinds.add(ObjectKind.ORIGINAL)
        self.report = IntegrityReport()

    def verify(self, one: ReferencedObject) -> IntegrityFault | None:
        """Return the first fault of an object, if any."""
        wrong = None
        is_of_chunk = one.what in (ObjectKind.CHUNK, ObjectKind.FEATURES)
        chunk_id = one.row_id if is_of_chunk else None
        try:
            if one.what == ObjectKind.CHUNK:
                return self._verify_chunk(one)
            if one.what == ObjectKind.VOCABULARY:
                return self._verify_vocabulary(one)
            if one.what in self._read_kinds:
                size_bytes, sha256 = hash_object(self._store, one.key)
                self.report.read_bytes += size_bytes
                if sha256 != one.sha256:
                    wrong = f"{one.what} {one.row_id}: its hash differs"
            elif (info := self._store.head(one.key)) is None:
                raise object_not_found_error(one.key)
            elif one.size_bytes not in (None, info.size_bytes):
                wrong = f"it has {info.size_bytes} bytes instead of {one.size_bytes}"
        except NotFound as error:
            key = str(error.extra["key"])
            what = ObjectKind.MANIFEST if key == manifest_key(one.key) else one.what
            return IntegrityFault(FaultKind.MISSING, what, key, "it is not in the store", chunk_id)
        self.report.checked[one.what] += 1
        if wrong is None:
            return None
        return IntegrityFault(FaultKind.DAMAGED, one.what, one.key, wrong, chunk_id)

    def _verify_chunk(self, one: ReferencedObject) -> IntegrityFault | None:
        """Compare a chunk with its hash, its manifest and the catalog."""
        with self._catalog.read() as session:
            chunk = session.get(Chunk, one.row_id)
            if chunk is None:
                return None
            catalog_rows = session.execute(
                select(Descriptor.row, Descriptor.photo_id).where(Descriptor.chunk_id == chunk.id)
            ).all()

        def fault(kind: FaultKind, detail: str, *, of_manifest: bool = False) -> IntegrityFault:
            what = ObjectKind.MANIFEST if of_manifest else ObjectKind.CHUNK
            key = manifest_key(one.key) if of_manifest else one.key
            return IntegrityFault(kind, what, key, detail, chunk.id)

        data = self._store.get(one.key)
        self.report.checked["chunk"] += 1
        self.report.read_bytes += len(data)
        if hashlib.sha256(data).hexdigest() != chunk.sha256:
            return fault(FaultKind.DAMAGED, "its hash differs")
        vectors = decode_rows(data)
        if len(vectors) != chunk.rows or not rows_are_valid(vectors).all():
            detail = (
                f"it has {len(vectors)} of {chunk.rows} rows, or rows that are not unit vectors"
            )
            return fault(FaultKind.DIFFERENT, detail)
        manifest = read_manifest(self._store, one.key)
        if manifest is None:
            return fault(FaultKind.DAMAGED, "it can't be read", of_manifest=True)
        self.report.checked["manifest"] += 1
        if manifest.sha256 != chunk.sha256 or len(manifest.photo_ids) != chunk.rows:
            return fault(FaultKind.DIFFERENT, "it belongs to another chunk", of_manifest=True)
        misplaced = [
            photo_id
            for row, photo_id in catalog_rows
            if not 0 <= row < chunk.rows or manifest.photo_ids[row] != photo_id
        ]
        if misplaced:
            detail = (
                f"{len(misplaced)} photos have another row in the catalog, first {misplaced[0]}"
            )
            return fault(FaultKind.DIFFERENT, detail)
        return None

    def _verify_vocabulary(self, one: ReferencedObject) -> IntegrityFault | None:
        with self._catalog.read() as session:
            stored = session.get(Vocabulary, one.row_id)
        if stored is None:
            return None
        data = self._store.get(one.key)
        self.report.checked[one.what] += 1
        self.report.read_bytes += len(data)
        try:
            intact = hashlib.sha256(decode_rows(data).tobytes()).hexdigest() == stored.sha256
        except (ValueError, KeyError):  # its header is damaged
            intact = False
        detail = "its centres are not those that were stored"
        return None if intact else IntegrityFault(FaultKind.DAMAGED, one.what, one.key, detail)


def _find_missing_descriptors(session: Session) -> list[IntegrityFault]:
    """Return live photos whose job succeeded, but that have no descriptor."""
    descriptor = select(Descriptor.photo_id).where(
        Descriptor.photo_id == Photo.id, Descriptor.generation_id == Generation.id
    )
    missing = session.execute(
        select(Photo.id, Generation.id)
        .join(Map, Map.id == Photo.map_id)
        .join(Job, Job.id == Photo.job_id)
        .join(Generation, Generation.map_id == Map.id)
        .where(
            Photo.deleted_at.is_(None),
            Map.deleted_at.is_(None),
            Generation.state == GenerationState.ACTIVE,
            Job.state == JobState.SUCCEEDED,
            ~descriptor.exists(),
        )
    )
    return [
        IntegrityFault(
            FaultKind.NOT_DESCRIBED,
            "photo",
            str(photo_id),
            f"it has no row in the active generation {generation_id}",
            photo_id=photo_id,
        )
        for photo_id, generation_id in missing
    ]


def repair_descriptors(catalog: Catalog, wakeups: Wakeups, report: IntegrityReport) -> int:
    """Queue the photos of damaged chunks and those without a descriptor; return their number.

    The rows of the chunks are deleted in the same transaction: until a photo is described again, it
    is not found, but no wrong result is either. A chunk with a damaged feature file has none any
    more: searches do not match its photos.
    """
    queued = 0
    faults = [(f.chunk_id, f.what) for f in report.faults if f.chunk_id is not None]
    without_features = [chunk_id for chunk_id, what in faults if what == ObjectKind.FEATURES]
    if without_features:
        none = {"features_model": None, "features_rows": 0, "features_bytes": 0}
        with catalog.write() as session:
            session.execute(update(Chunk).where(Chunk.id.in_(without_features)).values(**none))
    damaged = (chunk_id for chunk_id, what in faults if what != ObjectKind.FEATURES)
    for chunk_id in dict.fromkeys(damaged):
        queued += catalog.run(partial(discard_chunk, chunk_id=chunk_id))
    photo_ids = [fault.photo_id for fault in report.faults if fault.photo_id is not None]
    if photo_ids:
        queued += catalog.run(lambda session: _queue_photos(session, photo_ids))
    if queued:
        wakeups.send()
    return queued


def discard_chunk(session: Session, chunk_id: UUID) -> int:
    """Delete a chunk's rows and queue its photos again; return the number of photos."""
    chunk = session.get(Chunk, chunk_id)
    if chunk is None or chunk.superseded_at is not None:
        return 0  # compacted or repaired meanwhile
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
    # In a generation being built, the steward queues the photos of cancelled jobs again, and search
    # workers have to load them before it is activated.
    generation.complete_version = generation.complete_at = None
    session.execute(
        update(Job)
        .where(
            Job.kind == JobKind.REINDEX,
            Job.generation_id == generation.id,
            Job.photo_id.in_(photo_ids),
        )
        .values(state=JobState.CANCELLED)
        .execution_options(synchronize_session=False)
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
        requeue_job_as_new(job)
        return
    photo.job_id = new_id()
    session.add(Job(id=photo.job_id, map_id=photo.map_id, kind=JobKind.INDEX, photo_id=photo.id))
