"""Originals that no journal names: uploads of the catalog's last seconds, or of a home from before
the journal."""

from __future__ import annotations

import contextlib
import hashlib
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.maps import DEFAULT_MAP, Map, get_or_create_default_map
from shared.catalog.photos import Photo
from shared.catalog.session import Catalog
from shared.errors import Misconfigured, NotFound, PlacewiseError, Unavailable
from shared.intake.incoming import ValidatedPhoto, validate_photo
from shared.intake.received import StoredUpload
from shared.intake.store_photo import insert_photo, retry_on_conflict
from shared.jobs.batches import BatchItem
from shared.objects import ObjectStore
from shared.objects.keys import ORIGINALS
from shared.photo_formats import PHOTO_SIGNATURE_BYTES
from shared.rebuild.states import Progress
from shared.settings import Settings

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
    digest, begin = hashlib.sha256(), b""
    with store.open(key) as file:
        while piece := file.read(PIECE_BYTES):
            begin = begin or piece[:PHOTO_SIGNATURE_BYTES]
            digest.update(piece)
    name = f"{key.removeprefix(ORIGINALS)}.photo"
    return StoredUpload(key, name, size_bytes, digest.hexdigest(), begin)
