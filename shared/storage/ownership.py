"""The owner of an object store: each store belongs to one catalog, whose id it carries as a mark.

In a store that another catalog uses as well, each Placewise would collect the objects that its own
catalog does not know. A store that is not the one of before holds none of the photos. A folder and
a bucket carry the same mark, the note `.placewise`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TypedDict
from uuid import UUID

from shared.errors import Misconfigured
from shared.storage.folder import OWNER_MARK, PARTIAL_SUFFIX, FolderStore
from shared.storage.keys import ORIGINALS, QUERIES, WORK, is_original_key
from shared.storage.protocol import OwnedStore
from shared.storage.s3 import S3Store

log = logging.getLogger(__name__)

WAYS_OUT = (
    "Restore the catalog (the file itself, or `placewise restore` into an empty one) or correct "
    "DATABASE_URL; rebuild the catalog from the objects: placewise rebuild-catalog; or make this "
    "catalog the owner, which does not know those objects: placewise storage adopt."
)


class Place(TypedDict):
    """Where a bucket is."""

    endpoint: str
    bucket: str


def claim_store(
    store: OwnedStore,
    owner: UUID,
    before: Place | None,
    folder: Path,
    named_keys: Callable[[], Collection[str]],
    import_prefix: str,
) -> Place | None:
    """Mark a store that is used for the first time; check the mark at every other start.

    `owner` is the catalog's id, `before` the bucket that the catalog remembers, `folder` where its
    objects lie without a bucket, `named_keys` gives a sample of the keys that the catalog's rows
    name: a store without a mark that has them is marked. Returns the bucket, None for a folder.
    Safe to call from several processes of one catalog at once.

    Raises Misconfigured: `bucket_taken`, `folder_taken` for a store that is not this catalog's;
    `object_store_changed` where the objects that the catalog knows would be out of reach. Raises
    Unavailable as `check` does.
    """
    place = place_of(store)
    if place is None and before is not None:
        raise Misconfigured(
            "object_store_changed",
            f"The objects lie in the bucket {before['bucket']} at {before['endpoint']}, and "
            "S3_ENDPOINT is not set. Set it with its keys.",
        )
    if place is not None:
        store.check()
    found = read_owner(store)
    if found is None:
        if place is not None and before is not None and before != place:
            raise Misconfigured(
                "object_store_changed",
                f"The objects lie in the bucket {before['bucket']} at {before['endpoint']}; "
                f"S3_BUCKET is {place['bucket']} at {place['endpoint']}, which has no "
                f"{OWNER_MARK} of "
                f"it. To move them: copy the whole bucket, {OWNER_MARK} too.",
            )
        if place is not None and before is None:
            _check_no_objects(folder)
        _check_unmarked(store, named_keys(), import_prefix)
        store.write_note(OWNER_MARK, str(owner).encode(), replace=False)
        found = read_owner(store)  # another catalog's process may have come at the same moment
    if found != str(owner):
        raise taken(store, "belongs to another catalog than this one")
    return place


def place_of(store: OwnedStore) -> Place | None:
    """The bucket; None for a folder."""
    if not isinstance(store, S3Store):
        return None
    return Place(endpoint=store.bucket.endpoint, bucket=store.bucket.name)


def read_owner(store: OwnedStore) -> str | None:
    """The id of the catalog that owns the store; None for a store without a mark."""
    mark = store.read_note(OWNER_MARK)
    return None if mark is None else mark.decode().strip()


def check_free(store: OwnedStore, import_prefix: str) -> None:
    """Misconfigured as `claim_store`, for a store that a new catalog can't own."""
    if read_owner(store) is not None:
        raise taken(store, "belongs to a catalog, and this one is new")
    _check_unmarked(store, (), import_prefix)


def taken(store: OwnedStore, why: str) -> Misconfigured:
    """The refusal to use a store that is not this catalog's; it names what the operator can do."""
    code = "bucket_taken" if isinstance(store, S3Store) else "folder_taken"
    return Misconfigured(
        code,
        f"{_name_of(store)} {why} (DATABASE_URL, or PLACEWISE_HOME where that is not set). Nothing "
        f"was changed. {WAYS_OUT}",
    )


def _check_unmarked(store: OwnedStore, named: Collection[str], import_prefix: str) -> None:
    """Refuse a store without a mark, unless it is empty or has what the catalog names."""
    there = sum(store.head(key) is not None for key in named)
    if named and 2 * there >= len(named):  # single lost objects are for `placewise verify`
        log.info("%s has the catalog's objects, and is marked as the catalog's", _name_of(store))
        return
    if _holds_objects(store, import_prefix):
        raise taken(store, "holds objects that this catalog does not know")
    if named:
        raise Misconfigured(
            "object_store_changed",
            f"{_name_of(store)} is empty, and the catalog has photos or models that lie elsewhere. "
            "Is its disk mounted? Otherwise correct PLACEWISE_HOME or S3_BUCKET, or restore the "
            "objects from a backup (placewise restore).",
        )


def _holds_objects(store: OwnedStore, import_prefix: str) -> bool:
    """Whether it holds objects of some Placewise. What lies under IMPORT_PREFIX is its owner's. In
    a folder, which earlier releases did not mark, neither does count what was put into UPLOAD_DIR
    by hand, nor what a query has left for an hour."""
    for info in store.list(""):
        if info.key.startswith((OWNER_MARK, import_prefix)):
            continue
        by_hand = info.key.startswith(ORIGINALS) and not is_original_key(info.key)
        if isinstance(store, S3Store) or not (by_hand or info.key.startswith((QUERIES, WORK))):
            return True
    return False


def _name_of(store: OwnedStore) -> str:
    if isinstance(store, S3Store):
        return f"The bucket {store.bucket.name} (S3_BUCKET) at {store.bucket.endpoint}"
    assert isinstance(store, FolderStore), "there are two kinds"
    return f"The folder {store.root}"


def _check_no_objects(folder: Path) -> None:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != OWNER_MARK)
    if any(PARTIAL_SUFFIX not in path.parts for path in files):
        raise Misconfigured(
            "object_store_changed",
            f"Objects lie in {folder} already, and would be out of reach in a bucket. Unset "
            "S3_ENDPOINT, or take another PLACEWISE_HOME for the bucket.",
        )
