"""Ownership of an object store: each store belongs to one catalog and carries its id.

The id is in the note `.placewise` of the folder or bucket. The check prevents two failures. If two
catalogs used the same store, each would collect the objects that its own rows do not reference. If
the store is not the one used before, all photos would be missing.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from uuid import UUID

from shared.errors import Misconfigured
from shared.storage.folder import FolderStore
from shared.storage.keys import IMPORTS, ORIGINALS, OWNER_MARK, QUERIES, is_original_key
from shared.storage.protocol import OwnedStore

log = logging.getLogger(__name__)

RECOVERY_ADVICE = (
    "Restore the catalog (the file itself, or `placewise storage restore` into an empty one), "
    "correct DATABASE_URL, or rebuild the catalog from the objects: placewise storage rebuild."
)


def claim_store(store: OwnedStore, owner: UUID, sample_keys: Callable[[], Collection[str]]) -> None:
    """Mark a store that is used for the first time; check its owner at every other start.

    Several processes of one catalog may call it concurrently.

    Args:
        owner: the catalog's id.
        sample_keys: returns a sample of the keys that the catalog's rows reference. A store
            without a mark that has them is marked.

    Raises:
        Misconfigured: `bucket_taken`, `folder_taken` for a store of another catalog;
            `object_store_changed` where the catalog's objects would be missing.
        Unavailable: as `check`.
    """
    if not isinstance(store, FolderStore):
        store.check()
    current_owner = read_owner(store)
    if current_owner is None:
        _check_unmarked(store, sample_keys())
        store.write_note(OWNER_MARK, str(owner).encode(), replace=False)
        current_owner = read_owner(store)  # another catalog may have claimed it concurrently
    if current_owner != str(owner):
        raise store_taken_error(store, "belongs to another catalog than this one")


def read_owner(store: OwnedStore) -> str | None:
    """Return the id of the catalog that owns the store; None for a store without a mark."""
    mark = store.read_note(OWNER_MARK)
    return None if mark is None else mark.decode().strip()


def check_free(store: OwnedStore) -> None:
    """Raise Misconfigured as `claim_store` for a store that a new catalog can't own."""
    if read_owner(store) is not None:
        raise store_taken_error(store, "belongs to a catalog, and this one is new")
    _check_unmarked(store, ())


def store_taken_error(store: OwnedStore, reason: str) -> Misconfigured:
    """Return the error for a store of another catalog, with advice for the operator."""
    code = "folder_taken" if isinstance(store, FolderStore) else "bucket_taken"
    return Misconfigured(
        code,
        f"{_display_name(store)} {reason} (DATABASE_URL, or PLACEWISE_HOME where that is not set). "
        f"Nothing was changed. {RECOVERY_ADVICE}",
    )


def _check_unmarked(store: OwnedStore, sample: Collection[str]) -> None:
    """Reject a store without a mark, unless it is empty or has the sample of referenced keys."""
    present = sum(store.head(key) is not None for key in sample)
    if sample and 2 * present >= len(
        sample
    ):  # `placewise storage verify` reports single lost objects
        log.info(
            "%s has the catalog's objects and is now marked as owned by it", _display_name(store)
        )
        return
    if _has_objects(store):
        raise store_taken_error(store, "has objects that this catalog does not know")
    if sample:
        raise Misconfigured(
            "object_store_changed",
            f"{_display_name(store)} is empty, but the catalog references photos or models. "
            "Is the disk mounted? Otherwise correct PLACEWISE_HOME, or S3_ENDPOINT and S3_BUCKET; "
            f"to move the objects, copy all of them, including {OWNER_MARK}; or restore them from "
            "a backup (placewise storage restore).",
        )


def _has_objects(store: OwnedStore) -> bool:
    """Return whether the store has objects that a Placewise has written.

    Objects under `imports/` belong to the operator. In a folder, files that people put into
    UPLOAD_DIR and temporary objects of queries don't count either.
    """
    for info in store.list(""):
        if info.key.startswith((OWNER_MARK, IMPORTS)):
            continue
        is_foreign = info.key.startswith(ORIGINALS) and not is_original_key(info.key)
        if isinstance(store, FolderStore) and (is_foreign or info.key.startswith(QUERIES)):
            continue
        return True
    return False


def _display_name(store: OwnedStore) -> str:
    if isinstance(store, FolderStore):
        return f"The folder {store.root}"
    from shared.storage.s3 import S3Store  # importing minio is slow

    assert isinstance(store, S3Store), "there are two kinds"
    return f"The bucket {store.bucket.name} (S3_BUCKET) at {store.bucket.endpoint}"
