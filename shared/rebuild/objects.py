"""Recovers chunks of active generations, and originals that are not in the journal.

Such originals are uploads of the last seconds before the catalog was lost, or are from a release
without a journal.
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

from sqlalchemy import insert, select, update
from sqlalchemy.orm import Session

from shared.catalog.batch_items import BatchItem
from shared.catalog.chunks import Chunk, Descriptor, allocate_slot
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, RowType, lock_generation
from shared.catalog.maps import (
    DEFAULT_MAP,
    Map,
    get_or_create_default_map,
    increment_map_version,
    lock_map,
)
from shared.catalog.photos import Photo, get_live_photos
from shared.config.settings import Settings
from shared.errors import Misconfigured, NotFound, PlacewiseError, Unavailable
from shared.extractor_config.configs import pooled_config
from shared.ingest.store_photo import insert_photo
from shared.ingest.validation import StoredUpload, ValidatedPhoto, validate_photo
from shared.rebuild.rows import ROWS_PER_STATEMENT, Progress
from shared.storage import ObjectStore
from shared.storage.chunks import decode_rows, manifest_key, rows_are_valid
from shared.storage.keys import ORIGINALS

CHUNKS = "chunks/"


@dataclass(slots=True)
class RecoveredChunks:
    """Counts of the recovered chunks."""

    chunks: int = 0
    descriptors: int = 0
    damaged: list[str] = field(default_factory=list)
    """Keys of chunks that contradict their manifests."""
    unnamed_rows: int = 0
    newest_extractor: str | None = None
    """Extractor of the newest chunk whose generation is not in the catalog."""


@dataclass(frozen=True, slots=True)
class _Manifest:
    chunk_id: UUID
    generation_id: UUID
    sha256: str
    photo_ids: list[UUID]
    extractor: str


def recover_chunks(
    catalog: Catalog, store: ObjectStore, slot_rows: int, progress: Progress
) -> RecoveredChunks:
    """Register the chunks with rows of photos that lack a descriptor in their active generation.

    Newest chunks first: compaction writes a new chunk with the same rows as the older ones. Every
    chunk is verified against the hash in its manifest.
    """
    recovered = RecoveredChunks()
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
            recovered.damaged.append(key)
        elif manifest.generation_id not in states:
            recovered.unnamed_rows += len(manifest.photo_ids)
            recovered.newest_extractor = recovered.newest_extractor or manifest.extractor
        elif states[manifest.generation_id] == GenerationState.ACTIVE:
            _recover_chunk(catalog, store, key, manifest, slot_rows, recovered)
        progress("chunks", done, len(keys))
    return recovered


def _recover_chunk(
    catalog: Catalog,
    store: ObjectStore,
    key: str,
    manifest: _Manifest,
    slot_rows: int,
    recovered: RecoveredChunks,
) -> None:
    with catalog.read() as session:
        known = session.scalar(select(Chunk.id).where(Chunk.object_key == key))
        if known is not None or not _missing_descriptors(session, manifest):
            return
    try:
        data = store.get(key)
    except NotFound:
        return  # compacted and deleted meanwhile
    if hashlib.sha256(data).hexdigest() != manifest.sha256:
        recovered.damaged.append(key)
        return
    rows = decode_rows(data)
    if len(rows) != len(manifest.photo_ids) or not rows_are_valid(rows).all():
        recovered.damaged.append(key)
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
    recovered.chunks += bool(descriptors)
    recovered.descriptors += descriptors


def _commit(
    session: Session,
    *,
    manifest: _Manifest,
    object_key: str,
    rows: int,
    size_bytes: int,
    slot_rows: int,
) -> int:
    """Insert the chunk and its missing descriptors; return their number."""
    map_id = session.get_one(Generation, manifest.generation_id).map_id
    lock_map(session, map_id)
    generation = lock_generation(session, manifest.generation_id)
    missing = _missing_descriptors(session, manifest)
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


def _missing_descriptors(session: Session, manifest: _Manifest) -> list[tuple[int, UUID]]:
    """Return (row, photo id) of the chunk's live photos without a descriptor in the generation."""
    map_id = session.get_one(Generation, manifest.generation_id).map_id
    described: set[UUID] = set()
    live: set[UUID] = set()
    for begin in range(0, len(manifest.photo_ids), ROWS_PER_STATEMENT):
        batch = manifest.photo_ids[begin : begin + ROWS_PER_STATEMENT]
        live |= {p.id for p in get_live_photos(session, batch).values() if p.map_id == map_id}
        described |= set(
            session.scalars(
                select(Descriptor.photo_id).where(
                    Descriptor.generation_id == manifest.generation_id,
                    Descriptor.photo_id.in_(batch),
                )
            )
        )
    missing = live - described
    # A photo may have two rows in a chunk that was compacted while it was described again.
    rows = {photo_id: row for row, photo_id in enumerate(manifest.photo_ids) if photo_id in missing}
    return [(row, photo_id) for photo_id, row in rows.items()]


def _read_manifest(store: ObjectStore, key: str) -> _Manifest | None:
    """Return the manifest of a chunk; None if it is missing or invalid."""
    try:
        content = json.loads(store.get(manifest_key(key)))
        return _Manifest(
            UUID(content["chunk_id"]),
            UUID(content["generation_id"]),
            str(content["sha256"]),
            [UUID(photo_id) for photo_id in content["photo_ids"]],
            str(content["spec"]["extractor"]),
        )
    except (NotFound, ValueError, KeyError, TypeError, AttributeError):
        return None


@dataclass(slots=True)
class RecoveredOriginals:
    """Counts of the recovered originals."""

    photos: int = 0
    unreadable: list[str] = field(default_factory=list)
    """Keys of originals that are not valid photos."""


def recover_originals(
    catalog: Catalog,
    store: ObjectStore,
    settings: Settings,
    unnamed: list[tuple[str, int, float]],
    extractor: str | None,
    progress: Progress,
) -> RecoveredOriginals:
    """Add originals that no row references to the default map, with their EXIF data.

    They are stored like uploads. Originals with the bytes of a live photo are skipped.

    Args:
        settings: limits and the extractor of new maps.
        unnamed: key, size in bytes and time (seconds since 1970) of the originals.
        extractor: extractor of the default map, if it is created now and may be loaded here.
    """
    recovered = RecoveredOriginals()
    for done, (key, _, modified_at) in enumerate(unnamed, start=1):
        progress("originals that are not in the journal", done, len(unnamed))
        with catalog.read() as session:
            if _is_known(session, key):
                continue
        try:
            name = key.removeprefix(ORIGINALS)
            received = StoredUpload.read(store, key, name if "." in name else f"{name}.photo")
            incoming = validate_photo(store, received, settings.max_image_pixels)
        except NotFound:
            continue  # deleted since it was listed
        except Unavailable:
            raise
        except PlacewiseError:
            recovered.unreadable.append(key)
            continue
        uploaded_at = datetime.fromtimestamp(modified_at, UTC)
        recovered.photos += _store(catalog, settings, incoming, uploaded_at, extractor)
    return recovered


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
            return False  # an unacknowledged second upload of the same bytes
        map_id = _default_map(session, settings, extractor)
        photo = insert_photo(session, map_id, incoming).photo
        session.execute(update(Photo).where(Photo.id == photo.id).values(uploaded_at=uploaded_at))
        return True


def _default_map(session: Session, settings: Settings, extractor: str | None) -> UUID:
    existing_id = session.scalar(select(Map.id).where(Map.name == DEFAULT_MAP))
    if existing_id is not None:
        return existing_id
    name = settings.new_map_extractor
    if extractor is not None and not _is_pooled_start(settings, extractor):
        # The extractor may not be loadable here; the photos are then described with the default.
        with contextlib.suppress(Misconfigured):
            name = settings.extractor_config(extractor).name
    return get_or_create_default_map(session, name, RowType(settings.descriptor_rows)).id


def _is_pooled_start(settings: Settings, extractor: str) -> bool:
    """Return whether new maps begin with this extractor until they have a vocabulary."""
    config = settings.extractor_config(settings.new_map_extractor)
    return (
        settings.pool_without_vocabulary
        and config.needs_vocabulary
        and pooled_config(config).name == extractor
    )


def _is_known(session: Session, key: str) -> bool:
    """Return whether a photo or an unfinished batch references the object."""
    return (
        session.scalar(select(Photo.id).where(Photo.object_key == key).limit(1)) is not None
        or session.scalar(select(BatchItem.job_id).where(BatchItem.object_key == key).limit(1))
        is not None
    )
