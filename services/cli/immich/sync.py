"""Keeps a map as a library is: indexes its photos with coordinates, incrementally.

What the map has of the library is in the map itself: each photo has the library's tag, and its
`metadata` has the photo's id and state there. So any machine can continue, after any interruption.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

from rich.progress import Progress

from placewise.answers import Photo
from placewise.client import Client
from services.cli.ingest.geotags import LocalPhoto
from services.cli.ingest.upload import upload_photos
from services.cli.locate.library import LibraryPhoto, PhotoLibrary
from services.cli.output import Json, utf8_path
from shared.errors import NotFound
from shared.ingest.photo_metadata import parse_relative_path


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
    stored: dict[str, Photo] = {
        each.metadata["library_id"]: each
        for each in client.photos(tags=library.identity)
        if "library_id" in each.metadata
    }
    gone = stored.keys() - located.keys()
    if gone - {photo.id for photo in photos}:  # a listing may miss what others move meanwhile
        gone -= {photo.id for photo in library.list_photos() if photo.latitude is not None}
    changed = 0
    uploads: dict[str, LocalPhoto] = {}
    for photo_id, photo in located.items():
        there, fields = stored.get(photo_id), _fields(photo)
        if there is None or there.metadata["library_state"] != photo.state:
            uploads[photo_id] = _upload(library, photo, fields)
        elif fields != {name: _as_json(getattr(there, name)) for name in fields}:
            client.patch_photo(there.image_id, **fields)
            changed += 1
    report = upload_photos(client, list(uploads.values()), progress)
    failed = report["refused"] + report["failed"]
    kept = {each["path"] for each in failed}
    replaced = {key for key, each in uploads.items() if utf8_path(each.path) not in kept}
    for photo_id in gone | (replaced & stored.keys()):
        with contextlib.suppress(NotFound):  # somebody else was faster
            client.delete_photo(stored[photo_id].image_id)
    return {
        "with_coordinates": len(located),
        "indexed": len(replaced),
        "changed": changed,
        "removed": len(gone),
        "searchable": client.stats().searchable_images,
        "failed": failed,
    }


def _upload(library: PhotoLibrary, photo: LibraryPhoto, fields: Json) -> LocalPhoto:
    metadata = json.dumps({"library_id": photo.id, "library_state": photo.state})
    form = {name: str(value) for name, value in fields.items() if value is not None}
    form |= {"tags": library.identity, "metadata": metadata}
    return _LibraryUpload(Path(photo.name), form, library=library, photo=photo)


def _fields(photo: LibraryPhoto) -> Json:
    return {
        "latitude": photo.latitude,
        "longitude": photo.longitude,
        "captured_at": _as_json(photo.time),
        "relative_path": parse_relative_path(photo.name),
    }


def _as_json(value: Any) -> Any:
    return value.isoformat() if isinstance(value, datetime) else value
