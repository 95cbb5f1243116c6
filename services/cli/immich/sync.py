"""Keeps a map as a library is: indexes its photos with coordinates, incrementally.

What the map has of the library is in the map itself: each photo has the library's tag, and its
`metadata` has the photo's id and state there. So any machine can continue, after any interruption.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
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
from services.cli.output import Json
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
    current, outdated, changed = set[str](), set[str](), 0
    for there in _stored_photos(client, library):
        if not _is_current(there, located):
            outdated.add(_id(there))
            continue
        current.add(_id(there))
        fields = _fields(located[_id(there)])
        if fields != {name: _as_json(getattr(there, name)) for name in fields}:
            client.patch_photo(there.image_id, **fields)
            changed += 1
    uploads = [_upload(library, each) for each in located.values() if each.id not in current]
    report = upload_photos(client, uploads, progress, update=True)
    failed = report["refused"] + report["failed"]
    failed_paths = {each["path"] for each in failed}
    gone = outdated - located.keys()
    if gone - {photo.id for photo in photos}:  # a listing may miss what others move meanwhile
        gone -= {photo.id for photo in library.list_photos() if photo.latitude is not None}
    for there in _stored_photos(client, library) if outdated else ():
        photo = located.get(_id(there))
        is_replaced = photo is not None and str(Path(photo.name)) not in failed_paths
        if _id(there) in gone or (is_replaced and not _is_current(there, located)):
            with contextlib.suppress(NotFound):  # somebody else was faster
                client.delete_photo(there.image_id)
    return {
        "with_coordinates": len(located),
        "indexed": len(uploads) - len(failed),
        "changed": changed,
        "removed": len(gone),
        "searchable": client.stats().searchable_images,
        "failed": failed,
    }


def _stored_photos(client: Client, library: PhotoLibrary) -> Iterator[Photo]:
    photos = client.photos(tags=library.identity)
    return (each for each in photos if "library_id" in each.metadata)


def _id(photo: Photo) -> str:
    return str(photo.metadata["library_id"])


def _is_current(photo: Photo, located: Mapping[str, LibraryPhoto]) -> bool:
    """Return whether the photo has the picture that the library has now."""
    there = located.get(_id(photo))
    return there is not None and photo.metadata["library_state"] == there.state


def _upload(library: PhotoLibrary, photo: LibraryPhoto) -> LocalPhoto:
    metadata = json.dumps({"library_id": photo.id, "library_state": photo.state})
    form = {name: str(value) for name, value in _fields(photo).items() if value is not None}
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
