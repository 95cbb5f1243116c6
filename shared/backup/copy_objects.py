"""Copying one object from store to store, hashed on the way."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

from shared.backup.folder import BackedUpObject, BackupFolder
from shared.objects import ObjectStore
from shared.objects.folder import OWNER_MARK
from shared.objects.keys import (
    FEATURES,
    INCOMING,
    ORIGINALS,
    QUERIES,
    TRASH,
    WORK,
    is_original_key,
)
from shared.objects.port import ObjectInfo

COPY_BLOCK_BYTES = 1024 * 1024
# Notes of the store itself; made again when they are wanted; of calls that have ended by the time
# of a restore; orphans.
EXCLUDED_PREFIXES = (OWNER_MARK, INCOMING, QUERIES, FEATURES, TRASH, WORK)


def list_backup_objects(store: ObjectStore, import_prefix: str) -> Iterator[ObjectInfo]:
    """What belongs into a backup of the store, whether rows name it or not (thumbnails, codes).
    What lies under `import_prefix`, or was put into UPLOAD_DIR by hand, is its owner's."""
    for info in store.list(""):
        others = info.key.startswith(ORIGINALS) and not is_original_key(info.key)
        if others or info.key.startswith((*EXCLUDED_PREFIXES, import_prefix)):
            continue
        yield info


def is_backed_up(folder: BackupFolder, info: ObjectInfo) -> bool:
    """Whether the backup has the object as it is now."""
    kept = folder.index.get(info.key)
    return (
        kept is not None
        and kept.size_bytes == info.size_bytes
        and kept.modified == info.modified_at.isoformat()
        and folder.objects.path(info.key).is_file()
    )


def back_up_object(store: ObjectStore, folder: BackupFolder, info: ObjectInfo) -> int:
    """Copy the object into the backup; its bytes. NotFound when it is gone."""
    size, sha256 = copy_object(store, folder.objects, info.key)
    folder.note(BackedUpObject(info.key, size, sha256, info.modified_at.isoformat()))
    return size


def copy_object(source: ObjectStore, target: ObjectStore, key: str) -> tuple[int, str]:
    """Copy the object; its size in bytes and its SHA-256. NotFound where there is none."""
    digest, size = hashlib.sha256(), 0
    with source.open(key) as file:
        writer = target.writer(key)
        try:
            while piece := file.read(COPY_BLOCK_BYTES):
                digest.update(piece)
                writer.write(piece)
                size += len(piece)
            writer.commit()
        finally:
            writer.abort()
    return size, digest.hexdigest()


def hash_object(store: ObjectStore, key: str) -> tuple[int, str]:
    """The object's size in bytes and its SHA-256. NotFound where there is none."""
    digest, size = hashlib.sha256(), 0
    with store.open(key) as file:
        while piece := file.read(COPY_BLOCK_BYTES):
            digest.update(piece)
            size += len(piece)
    return size, digest.hexdigest()
