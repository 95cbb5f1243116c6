"""From a prefix of the object store to the items of a batch: every photo below it, by its key."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

from services.steward.batches.list_archive import BatchListing
from shared.datasets.utm_names import upload_fields_of_file_name
from shared.errors import PlacewiseError, TooLarge, Unprocessable
from shared.jobs import JobState
from shared.objects import ObjectStore
from shared.photo_formats import PHOTO_SUFFIXES


def list_prefix_photos(store: ObjectStore, prefix: str, max_photos: int) -> BatchListing:
    """The photos below the prefix in the order of their keys, with what their names say of them.

    Objects that have no photo's suffix, or a hidden name, are passed over and counted. Raises
    Unprocessable (`no_photos`), TooLarge (`too_many_photos_error`), Unavailable.
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
                f"There are more than {max_photos} photos below {prefix} (MAX_BATCH_PHOTOS). "
                "Name a longer prefix.",
            )
    if not keys:
        raise Unprocessable("no_photos", f"The object store has no photo below {prefix}.")
    listing.items = [_object_item(key) for key in sorted(keys)]
    return listing


def _object_item(key: str) -> dict[str, Any]:
    item: dict[str, Any] = {"name": key, "object_key": key}
    try:
        return {**item, "fields": upload_fields_of_file_name(PurePosixPath(key).name, None)}
    except PlacewiseError as error:
        return {**item, "state": JobState.FAILED, "error": error.as_problem()}
