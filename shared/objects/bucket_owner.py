"""Whose bucket it is: an embedded Placewise has one for itself.

Its home and its bucket carry the same mark. In a bucket that another home uses as well, each would
remove the objects that its own catalog does not know; and a bucket that is not the one of before
holds none of the photos.
"""

from __future__ import annotations

import json
from pathlib import Path

from shared.errors import Misconfigured, NotFound
from shared.home import write_private
from shared.ids import new_id
from shared.objects.folder import MARK, PARTIAL
from shared.objects.s3 import S3Store


def claim_bucket(home: Path, store: S3Store) -> None:
    """Mark a bucket that is used for the first time; make sure of it at every other start.

    Raises Misconfigured: `bucket_taken` for one that is not this home's, `object_store_changed`
    where the objects that the home has would be out of reach. Raises Unavailable as `check` does.
    """
    store.check()
    bucket = store.bucket
    note = _note(home)
    before: dict[str, str] = json.loads(note.read_text()) if note.exists() else {}
    try:
        found = store.get(MARK).decode().strip()
    except NotFound:
        if before:
            raise Misconfigured(
                "object_store_changed",
                f"The objects lie in the bucket {before['bucket']} at {before['endpoint']}; "
                f"S3_BUCKET is {bucket.name} at {bucket.endpoint}, which has no {MARK} of it. To "
                f"move them: copy the whole bucket, {MARK} too.",
            ) from None
        _check_no_objects(home / "objects")
        if next(store.list(""), None) is not None:
            raise Misconfigured(
                "bucket_taken",
                f"The bucket {bucket.name} (S3_BUCKET) at {bucket.endpoint} holds other things "
                "already. Give Placewise a bucket of its own: placewise storage create-bucket.",
            ) from None
        found = str(new_id())
        store.put(MARK, found.encode())
    else:
        if found != before.get("id"):
            raise Misconfigured(
                "bucket_taken",
                f"The bucket {bucket.name} (S3_BUCKET) at {bucket.endpoint} belongs to another "
                f"PLACEWISE_HOME than {home}. Give this one a bucket of its own; or, if the other "
                f"one is gone, delete {MARK} and everything else in it.",
            )
    now = {"endpoint": bucket.endpoint, "bucket": bucket.name, "id": found}
    if now != before:
        write_private(note, json.dumps(now))


def check_no_bucket(home: Path) -> None:
    """Misconfigured (`object_store_changed`) where the home's objects lie in a bucket."""
    note = _note(home)
    if note.exists():
        said = json.loads(note.read_text())
        raise Misconfigured(
            "object_store_changed",
            f"The objects lie in the bucket {said['bucket']} at {said['endpoint']}, and "
            "S3_ENDPOINT is not set. Set it with its keys.",
        )


def _check_no_objects(objects: Path) -> None:
    files = (path for path in objects.rglob("*") if path.is_file())
    if any(PARTIAL not in path.parts for path in files):
        raise Misconfigured(
            "object_store_changed",
            f"Objects lie in {objects} already, and would be out of reach in a bucket. Unset "
            "S3_ENDPOINT, or take another PLACEWISE_HOME for the bucket.",
        )


def _note(home: Path) -> Path:
    return home / "bucket.json"
