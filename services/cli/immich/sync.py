"""Keeps a map as a library is: indexes its photos with coordinates, incrementally.

What the map has of the library is in the map itself: each photo has the library's tag, and its
`metadata` has the photo's id and state there. So any machine can continue, after any interruption.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from rich.progress import Progress

from placewise.answers import Photo
from placewise.client import Client
from services.cli.ingest.geotags import LocalPhoto
from services.cli.ingest.upload import upload_photos
from services.cli.locate.library import LibraryPhoto, PhotoLibrary
from services.cli.output import Json
from shared.errors import NotFound
from shared.ingest.photo_metadata import parse_relative_path

DEGREES = 7  # digits after the point


@dataclass(frozen=True, slots=True, kw_only=True)
class _LibraryUpload(LocalPhoto):
    """A photo that is uploaded from a library."""

    library: PhotoLibrary
    photo: LibraryPhoto

    def content(self) -> Path | BinaryIO:
        return self.library.fetch(self.photo)


def sync_map(
    client: Client, library: PhotoLibrary, photos: Sequence[LibraryPhoto], progress: Progress
) -> Json:
    """Index new photos with coordinates, and follow what was changed, moved or deleted.

    A photo whose picture is the same is not fetched. A photo without coordinates is not indexed.

    Args:
        photos: The library's photos as they were listed.

    Returns:
        Counts `with_coordinates`, `indexed`, `changed` (coordinates, time or name), `removed` and
        `searchable`, and the photos that `failed`, with reasons.
    """
    located = {photo.id: photo for photo in photos if photo.latitude is not None}
    stored = {
        str(each.metadata["library_id"]): each
        for each in client.photos(tags=library.identity)
        if "library_id" in each.metadata
    }
    outdated = [
        each
        for photo_id, each in stored.items()
        if photo_id in located and each.metadata["library_state"] != located[photo_id].state
    ]
    unlisted = stored.keys() - located.keys()
    if unlisted - {photo.id for photo in photos}:  # a listing may miss what others move meanwhile
        listed = {p.id for p in library.list_photos() if p.latitude is not None}
        unlisted -= listed
    for photo_id in unlisted:
        _delete(client, stored[photo_id])
    changed = 0
    for photo_id in stored.keys() & located.keys():
        there, fields = stored[photo_id], _fields(located[photo_id])
        if _stored_fields(there) != fields:
            client.patch_photo(there.image_id, **fields)
            changed += 1
    current = stored.keys() - {str(each.metadata["library_id"]) for each in outdated}
    uploads: list[LocalPhoto] = [
        _upload(library, photo) for photo_id, photo in located.items() if photo_id not in current
    ]
    report = upload_photos(client, uploads, progress)
    failed = report["refused"] + report["failed"]
    not_replaced = {each["path"] for each in failed}
    for each in outdated:
        if located[str(each.metadata["library_id"])].name not in not_replaced:
            _delete(client, each)
    return {
        "with_coordinates": len(located),
        "indexed": len(uploads) - len(failed),
        "changed": changed,
        "removed": len(unlisted),
        "searchable": client.stats().searchable_images,
        "failed": failed,
    }


def _upload(library: PhotoLibrary, photo: LibraryPhoto) -> _LibraryUpload:
    metadata = {"library_id": photo.id, "library_state": photo.state}
    fields = {name: str(value) for name, value in _fields(photo).items() if value is not None}
    return _LibraryUpload(
        path=Path(photo.name),
        fields={**fields, "tags": library.identity, "metadata": json.dumps(metadata)},
        library=library,
        photo=photo,
    )


def _fields(photo: LibraryPhoto) -> Json:
    assert photo.latitude is not None
    assert photo.longitude is not None
    return {
        "latitude": round(photo.latitude, DEGREES),
        "longitude": round(photo.longitude, DEGREES),
        "captured_at": None if photo.time is None else photo.time.isoformat(),
        "relative_path": parse_relative_path(photo.name),
    }


def _stored_fields(photo: Photo) -> Json:
    return {
        "latitude": photo.latitude,
        "longitude": photo.longitude,
        "captured_at": None if photo.captured_at is None else photo.captured_at.isoformat(),
        "relative_path": photo.relative_path,
    }


def _delete(client: Client, photo: Photo) -> None:
    try:
        client.delete_photo(photo.image_id)
    except NotFound:  # somebody else was faster
        return
