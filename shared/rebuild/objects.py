"""Chunks that lie in the store, back into the generations that answer.

Originals that no journal names: uploads of the catalog's last seconds, or of a home from before
the journal.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import Any
from uuid import UUID

from sqlalchemy import insert, select
from sqlalchemy.orm import Session

from shared.catalog.batch_items import BatchItem
from shared.catalog.chunks import Chunk, Descriptor, allocate_slot
from shared.catalog.generations import Generation, GenerationState, lock_generation
from shared.catalog.maps import (
    DEFAULT_MAP,
    Map,
    get_or_create_default_map,
    increment_map_version,
    lock_map,
)
from shared.catalog.photos import Photo, get_live_photos
from shared.catalog.session import Catalog
from shared.config.settings import Settings
from shared.errors import Misconfigured, NotFound, PlacewiseError, Unavailable
from shared.imaging.file_formats import PHOTO_SIGNATURE_BYTES
from shared.ingest.store_photo import insert_photo, retry_on_conflict
from shared.ingest.validation import StoredUpload, ValidatedPhoto, validate_photo
from shared.rebuild.rows import AT_ONCE, Progress
from shared.storage import ObjectStore
from shared.storage.chunks import decode_rows, manifest_key, rows_are_valid
from shared.storage.keys import ORIGINALS

CHUNKS = "chunks/"


@dataclass(slots=True)
class ChunksTakenIn:
    chunks: int = 0
    descriptors: int = 0
    damaged: list[str] = field(default_factory=list)
    """Keys of chunks that are not what their manifests say."""
    unnamed_rows: int = 0
    newest_extractor: str | None = None
    """That of the newest chunk of a generation that the catalog does not know."""


@dataclass(frozen=True, slots=True)
class _Manifest:
    chunk_id: UUID
    generation_id: UUID
    sha256: str
    photo_ids: list[UUID]
    extractor: str


def take_in_chunks(
    catalog: Catalog, store: ObjectStore, slot_rows: int, progress: Progress
) -> ChunksTakenIn:
    """Register the chunks that hold rows of photos which have none in their active generation.

    Newest first: merging writes a new chunk beside the older ones, and a row is the same in each.
    Every chunk is read against the hash of its manifest.
    """
    found = ChunksTakenIn()
    with catalog.read() as session:
        states: dict[UUID, GenerationState] = {
            row.id: row.state for row in session.execute(select(Generation.id, Generation.state))
        }
    keys = sorted(
        (info.key for info in store.list(CHUNKS) if info.key.endswith(".npy")),
        key=lambda key: key.rpartition("/")[2],
        reverse=True,
    )
    for done, key in enumerate(keys, start=1):
        manifest = _read_manifest(store, key)
        if manifest is None:
            found.damaged.append(key)
        elif manifest.generation_id not in states:
            found.unnamed_rows += len(manifest.photo_ids)
            found.newest_extractor = found.newest_extractor or manifest.extractor
        elif states[manifest.generation_id] == GenerationState.ACTIVE:
            _take_in(catalog, store, key, manifest, slot_rows, found)
        progress("chunks", done, len(keys))
    return found


def _take_in(
    catalog: Catalog,
    store: ObjectStore,
    key: str,
    manifest: _Manifest,
    slot_rows: int,
    found: ChunksTakenIn,
) -> None:
    with catalog.read() as session:
        known = session.scalar(select(Chunk.id).where(Chunk.object_key == key))
        if known is not None or not _without_row(session, manifest):
            return
    try:
        data = store.get(key)
    except NotFound:
        return  # superseded, and collected meanwhile
    if hashlib.sha256(data).hexdigest() != manifest.sha256:
        found.damaged.append(key)
        return
    rows = decode_rows(data)
    if len(rows) != len(manifest.photo_ids) or not rows_are_valid(rows).all():
        found.damaged.append(key)
        return
    descriptors = catalog.run(
        partial(
            _commit,
            manifest=manifest,
            object_key=key,
            rows=len(rows),
            size_bytes=len(data),
            slot_rows=slot_rows,
        )
    )
    found.chunks += bool(descriptors)
    found.descriptors += descriptors


def _commit(
    session: Session,
    *,
    manifest: _Manifest,
    object_key: str,
    rows: int,
    size_bytes: int,
    slot_rows: int,
) -> int:
    """Chunk and descriptors; how many of these."""
    map_id = session.get_one(Generation, manifest.generation_id).map_id
    lock_map(session, map_id)
    generation = lock_generation(session, manifest.generation_id)
    missing = _without_row(session, manifest)
    if not missing:
        return 0
    chunk = Chunk(
        id=manifest.chunk_id,
        generation_id=generation.id,
        slot=allocate_slot(generation, rows, slot_rows),
        object_key=object_key,
        rows=rows,
        size_bytes=size_bytes,
        sha256=manifest.sha256,
    )
    session.add(chunk)
    session.flush()
    descriptors: list[dict[str, Any]] = [
        {
            "generation_id": generation.id,
            "photo_id": photo_id,
            "chunk_id": chunk.id,
            "row": row,
        }
        for row, photo_id in missing
    ]
    session.execute(insert(Descriptor), descriptors)
    increment_map_version(session, map_id)
    return len(descriptors)


def _without_row(session: Session, manifest: _Manifest) -> list[tuple[int, UUID]]:
    """(row, photo) of the chunk's photos that are live and have no descriptor in the generation."""
    map_id = session.get_one(Generation, manifest.generation_id).map_id
    described: set[UUID] = set()
    live: set[UUID] = set()
    for begin in range(0, len(manifest.photo_ids), AT_ONCE):
        some = manifest.photo_ids[begin : begin + AT_ONCE]
        live |= {p.id for p in get_live_photos(session, some).values() if p.map_id == map_id}
        described |= set(
            session.scalars(
                select(Descriptor.photo_id).where(
                    Descriptor.generation_id == manifest.generation_id,
                    Descriptor.photo_id.in_(some),
                )
            )
        )
    wanted = live - described
    # A photo may have two rows in a chunk that was merged while it was described again.
    rows = {photo_id: row for row, photo_id in enumerate(manifest.photo_ids) if photo_id in wanted}
    return [(row, photo_id) for photo_id, row in rows.items()]


def _read_manifest(store: ObjectStore, key: str) -> _Manifest | None:
    """None for one that is missing, or none."""
    try:
        said = json.loads(store.get(manifest_key(key)))
        return _Manifest(
            UUID(said["chunk_id"]),
            UUID(said["generation_id"]),
            str(said["sha256"]),
            [UUID(photo_id) for photo_id in said["photo_ids"]],
            str(said["spec"]["extractor"]),
        )
    except (NotFound, ValueError, KeyError, TypeError, AttributeError):
        return None


PIECE_BYTES = 1024 * 1024


@dataclass(slots=True)
class OriginalsTakenIn:
    photos: int = 0
    unreadable: list[str] = field(default_factory=list)
    """Keys of what can't be taken for a photo."""


def take_in_originals(
    catalog: Catalog,
    store: ObjectStore,
    settings: Settings,
    unnamed: list[tuple[str, int, float]],
    extractor: str | None,
    progress: Progress,
) -> OriginalsTakenIn:
    """Make photos of the default map of those that no row knows, with what EXIF says of them; but
    not of bytes that a live photo has already. They go the way of every upload.

    `unnamed`: key, size in bytes and time (seconds since 1970). `extractor` is the default map's,
    where it is made now and this release has an extractor of that name.
    """
    taken = OriginalsTakenIn()
    for done, (key, size_bytes, modified_at) in enumerate(unnamed, start=1):
        progress("originals that the journal does not name", done, len(unnamed))
        with catalog.read() as session:
            if _is_known(session, key):
                continue
        try:
            received = _receive(store, key, size_bytes)
            incoming = validate_photo(store, received, settings.max_image_pixels)
        except NotFound:
            continue  # deleted since it was listed
        except Unavailable:
            raise
        except PlacewiseError:
            taken.unreadable.append(key)
            continue
        uploaded_at = datetime.fromtimestamp(modified_at, UTC)
        taken.photos += retry_on_conflict(
            partial(_store, catalog, settings, incoming, uploaded_at, extractor)
        )
    return taken


def _store(
    catalog: Catalog,
    settings: Settings,
    incoming: ValidatedPhoto,
    uploaded_at: datetime,
    extractor: str | None,
) -> bool:
    with catalog.write() as session:
        same = select(Photo.id).where(
            Photo.sha256 == incoming.received.sha256, Photo.deleted_at.is_(None)
        )
        if session.scalar(same.limit(1)) is not None:
            return False  # a second upload of the same bytes, which was not acknowledged
        map_id = _default_map(session, settings, extractor)
        insert_photo(session, map_id, incoming).photo.uploaded_at = uploaded_at
        return True


def _default_map(session: Session, settings: Settings, extractor: str | None) -> UUID:
    found = session.scalar(select(Map.id).where(Map.name == DEFAULT_MAP))
    if found is not None:
        return found
    name = settings.new_map_extractor
    if extractor is not None:
        # Else one that this installation may not load any more: its photos are described anew.
        with contextlib.suppress(Misconfigured):
            name = settings.recipe(extractor).name
    return get_or_create_default_map(session, name).id


def _is_known(session: Session, key: str) -> bool:
    """Whether a photo, or a batch that is under way, has the object."""
    return (
        session.scalar(select(Photo.id).where(Photo.object_key == key).limit(1)) is not None
        or session.scalar(select(BatchItem.job_id).where(BatchItem.object_key == key).limit(1))
        is not None
    )


def _receive(store: ObjectStore, key: str, size_bytes: int) -> StoredUpload:
    digest, first_bytes = hashlib.sha256(), b""
    with store.open(key) as file:
        while piece := file.read(PIECE_BYTES):
            first_bytes = first_bytes or piece[:PHOTO_SIGNATURE_BYTES]
            digest.update(piece)
    name = f"{key.removeprefix(ORIGINALS)}.photo"
    return StoredUpload(key, name, size_bytes, digest.hexdigest(), first_bytes)
