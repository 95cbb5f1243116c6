"""Lists the photos of a prefix of the object store as items of a batch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from shared.errors import PlacewiseError, TooLarge, Unprocessable
from shared.imaging.file_formats import PHOTO_SUFFIXES
from shared.jobs import JobState
from shared.storage import ObjectStore
from shared.utm_filenames import upload_fields_of_file_name


@dataclass(slots=True)
class BatchListing:
    """The items of a batch."""

    items: list[dict[str, Any]] = field(default_factory=list)
    """Columns of BatchItem."""
    ignored: int = 0
    """Number of objects that are not photos."""


def list_prefix_photos(store: ObjectStore, prefix: str, max_photos: int) -> BatchListing:
    """List the photos under a prefix by key, with the fields in their file names.

    Objects without a photo suffix and hidden ones are ignored and counted.

    Raises:
        Unprocessable: `no_photos`.
        TooLarge: `too_many_photos`: there are more than `max_photos`.
        Unavailable: The object store can't be reached.
    """
    listing = BatchListing()
    keys: list[str] = []
    for info in store.list(prefix):
        path = PurePosixPath(info.key.removeprefix(prefix))
        hidden = any(part.startswith(".") for part in path.parts)
        if hidden or path.suffix.lower() not in PHOTO_SUFFIXES:
            listing.ignored += 1
            continue
        keys.append(info.key)
        if len(keys) > max_photos:
            raise TooLarge(
                "too_many_photos",
                f"There are more than {max_photos} photos under {prefix} (half of "
                "MAX_QUEUED_JOBS). Use a longer prefix.",
            )
    if not keys:
        raise Unprocessable("no_photos", f"The object store has no photos under {prefix}.")
    listing.items = [_object_item(key) for key in sorted(keys)]
    return listing


def _object_item(key: str) -> dict[str, Any]:
    item: dict[str, Any] = {"name": key, "object_key": key}
    try:
        return {**item, "fields": upload_fields_of_file_name(PurePosixPath(key).name, None)}
    except PlacewiseError as error:
        return {**item, "state": JobState.FAILED, "error": error.as_problem()}
