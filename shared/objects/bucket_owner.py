"""Whose bucket it is: each belongs to one catalog, whose id it carries as a mark.

In a bucket that another catalog uses as well, each Placewise would remove the objects that its own
catalog does not know; and a bucket that is not the one of before holds none of the photos.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TypedDict
from uuid import UUID

from shared.errors import Misconfigured, NotFound
from shared.objects.folder import MARK, PARTIAL, FolderStore
from shared.objects.port import ObjectStore
from shared.objects.s3 import S3Store


class Place(TypedDict):
    """Where a bucket is."""

    endpoint: str
    bucket: str


def claim_bucket(store: S3Store, owner: UUID, before: Place | None, folder: Path) -> Place:
    """Mark a bucket that is used for the first time; make sure of it at every other start.

    `owner` is the catalog's id, `before` the bucket that it remembers, `folder` where its objects
    would lie without a bucket. Safe to call from several processes of one catalog at once.
    Raises Misconfigured: `bucket_taken` for one that is not this catalog's, `object_store_changed`
    where the objects that the catalog knows would be out of reach. Raises Unavailable as `check`
    does.
    """
    store.check()
    bucket = store.bucket
    found = _mark_of(store)
    if found is None:
        if before is not None:
            raise Misconfigured(
                "object_store_changed",
                f"The objects lie in the bucket {before['bucket']} at {before['endpoint']}; "
                f"S3_BUCKET is {bucket.name} at {bucket.endpoint}, which has no {MARK} of it. To "
                f"move them: copy the whole bucket, {MARK} too.",
            )
        _check_no_objects(folder)
        if any(info.key != MARK for info in store.list("")):
            raise Misconfigured(
                "bucket_taken",
                f"The bucket {bucket.name} (S3_BUCKET) at {bucket.endpoint} holds other things "
                "already. Give Placewise a bucket of its own: placewise storage create-bucket.",
            )
        store.put(MARK, str(owner).encode())
        found = _mark_of(store)  # another catalog's process may have come at the same moment
    if found != str(owner):
        raise Misconfigured(
            "bucket_taken",
            f"The bucket {bucket.name} (S3_BUCKET) at {bucket.endpoint} belongs to another catalog "
            "than this one (DATABASE_URL, or PLACEWISE_HOME where that is not set). Give this one "
            f"a bucket of its own; or, if the other one is gone, delete {MARK} and everything else "
            "in it.",
        )
    return Place(endpoint=bucket.endpoint, bucket=bucket.name)


def read_owner(store: ObjectStore) -> UUID | None:
    """The id of the catalog that the store is marked with; None for one without a mark."""
    found = None
    if isinstance(store, S3Store):
        found = _mark_of(store)
    elif isinstance(store, FolderStore):
        with contextlib.suppress(FileNotFoundError):
            found = (store.root / MARK).read_text().strip()
    try:
        return None if found is None else UUID(found)
    except ValueError:
        return None


def check_no_bucket(before: Place | None) -> None:
    """Misconfigured (`object_store_changed`) where the catalog's objects lie in a bucket."""
    if before is not None:
        raise Misconfigured(
            "object_store_changed",
            f"The objects lie in the bucket {before['bucket']} at {before['endpoint']}, and "
            "S3_ENDPOINT is not set. Set it with its keys.",
        )


def _mark_of(store: S3Store) -> str | None:
    try:
        return store.get(MARK).decode().strip()
    except NotFound:
        return None


def _check_no_objects(folder: Path) -> None:
    files = (path for path in folder.rglob("*") if path.is_file())
    if any(PARTIAL not in path.parts for path in files):
        raise Misconfigured(
            "object_store_changed",
            f"Objects lie in {folder} already, and would be out of reach in a bucket. Unset "
            "S3_ENDPOINT, or take another PLACEWISE_HOME for the bucket.",
        )
