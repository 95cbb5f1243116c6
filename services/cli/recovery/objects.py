"""Recovers chunks of the generations in use, and originals that are not in the journal.

Such originals are uploads of the last seconds before the catalog was lost, or their segment is
damaged.
"""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from uuid import UUID

from sqlalchemy import insert, select, update
from sqlalchemy.orm import Session

from services.cli.recovery.journal_rows import ROWS_PER_STATEMENT, Progress, RecoveryReport
from shared.catalog.batch_items import BatchItem
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import get_or_create_default_map, increment_map_version
from shared.catalog.photos import Photo
from shared.config.settings import Settings
from shared.errors import NotFound, PlacewiseError, Unavailable
from shared.ingest.store_photo import insert_photo
from shared.ingest.validation import StoredUpload, ValidatedPhoto, validate_photo
from shared.storage import ObjectStore
from shared.storage.chunks import (
    ChunkManifest,
    decode_rows,
    features_key,
    read_manifest,
    rows_are_valid,
)
from shared.storage.keys import ORIGINALS

CHUNKS = "chunks/"


def recover_chunks(
    catalog: Catalog, store: ObjectStore, recovered: RecoveryReport, progress: Progress
) -> None:
    """Register the chunks with rows of photos that lack a descriptor in their generation.

    Only active generations and those being built. Newest chunks first: compaction writes a new
    chunk with the same rows as the older ones. Every chunk is verified against the hash in its
    manifest.
    """
    with catalog.read() as session:
        states = {
            row.id: row.state for row in session.execute(select(Generation.id, Generation.state))
        }
    keys = sorted(
        (info.key for info in store.list(CHUNKS) if info.key.endswith(".npy")),
        key=lambda key: key.rpartition("/")[2],
        reverse=True,
    )
    for done, key in enumerate(keys, start=1):
        try:
            manifest = read_manifest(store, key)
        except NotFound:
            manifest = None
        if manifest is None:
            recovered.damaged_chunks.append(key)
        elif manifest.generation_id not in states:
            recovered.unnamed_descriptors += len(manifest.photo_ids)
        elif states[manifest.generation_id] in (GenerationState.ACTIVE, GenerationState.BUILDING):
            _recover_chunk(catalog, store, key, manifest, recovered)
        progress("chunks", done, len(keys))


def _recover_chunk(
    catalog: Catalog,
    store: ObjectStore,
    key: str,
    manifest: ChunkManifest,
    recovered: RecoveryReport,
) -> None:
    with catalog.read() as session:
        missing = _missing_descriptors(session, manifest)
    if not missing:
        return
    data = store.get(key)
    rows = decode_rows(data) if hashlib.sha256(data).hexdigest() == manifest.sha256 else None
    if rows is None or len(rows) != len(manifest.photo_ids) or not rows_are_valid(rows).all():
        recovered.damaged_chunks.append(key)
        return
    file = store.head(features_key(key)) if manifest.features else None
    has_features = file is not None and file.size_bytes == manifest.features["features_bytes"]
    with catalog.write() as session:
        generation = session.get_one(Generation, manifest.generation_id)
        session.add(
            Chunk(
                id=manifest.chunk_id,
                generation_id=generation.id,
                object_key=key,
                rows=len(rows),
                size_bytes=len(data),
                sha256=manifest.sha256,
                **(manifest.features if has_features else {}),
            )
        )
        session.flush()
        place = {"generation_id": generation.id, "chunk_id": manifest.chunk_id}
        descriptors = [
            {**place, "photo_id": photo_id, "row": row} for photo_id, row in missing.items()
        ]
        session.execute(insert(Descriptor), descriptors)
        increment_map_version(session, generation.map_id)
    recovered.chunks += 1
    recovered.descriptors += len(descriptors)


def _missing_descriptors(session: Session, manifest: ChunkManifest) -> dict[UUID, int]:
    """Return the rows of the chunk's photos that have no descriptor in the generation."""
    # A photo may have two rows in a chunk that was compacted while it was described again.
    rows = {photo_id: row for row, photo_id in enumerate(manifest.photo_ids)}
    photo_ids, missing = list(rows), set[UUID]()
    map_id = session.get_one(Generation, manifest.generation_id).map_id
    for begin in range(0, len(photo_ids), ROWS_PER_STATEMENT):
        batch = photo_ids[begin : begin + ROWS_PER_STATEMENT]
        present = select(Photo.id).where(Photo.id.in_(batch), Photo.map_id == map_id)
        described = select(Descriptor.photo_id).where(
            Descriptor.photo_id.in_(batch), Descriptor.generation_id == manifest.generation_id
        )
        missing |= {*session.scalars(present)} - {*session.scalars(described)}
    return {photo_id: row for photo_id, row in rows.items() if photo_id in missing}


def recover_originals(
    catalog: Catalog,
    store: ObjectStore,
    settings: Settings,
    unnamed: list[tuple[str, float]],
    recovered: RecoveryReport,
    progress: Progress,
) -> None:
    """Add originals that no row references to the default map, with their EXIF data.

    They are stored like uploads. Originals with the bytes of a live photo are skipped.

    Args:
        settings: limits and the extractor of new maps.
        unnamed: key and time (seconds since 1970) of the originals.
    """
    for done, (key, modified_at) in enumerate(unnamed, start=1):
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
            recovered.unreadable_originals.append(key)
            continue
        uploaded_at = datetime.fromtimestamp(modified_at, UTC)
        recovered.unnamed_photos += _store(catalog, settings, incoming, uploaded_at)


def _store(
    catalog: Catalog, settings: Settings, incoming: ValidatedPhoto, uploaded_at: datetime
) -> bool:
    with catalog.write() as session:
        same = select(Photo.id).where(
            Photo.sha256 == incoming.received.sha256, Photo.deleted_at.is_(None)
        )
        if session.scalar(same.limit(1)) is not None:
            return False  # an unacknowledged second upload of the same bytes
        extractor, row_type = settings.new_map_extractor, settings.descriptor_rows
        map_ = get_or_create_default_map(session, extractor, row_type)
        photo = insert_photo(session, map_.id, incoming).photo
        session.execute(update(Photo).where(Photo.id == photo.id).values(uploaded_at=uploaded_at))
        return True


def _is_known(session: Session, key: str) -> bool:
    """Return whether a photo or an unfinished batch references the object."""
    return (
        session.scalar(select(Photo.id).where(Photo.object_key == key).limit(1)) is not None
        or session.scalar(select(BatchItem.job_id).where(BatchItem.object_key == key).limit(1))
        is not None
    )
