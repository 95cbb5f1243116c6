"""Restores a backup into an empty Placewise: copies its objects, then rebuilds the catalog.

An interrupted restore can be repeated: it copies the missing objects and continues the rebuild.
"""

from __future__ import annotations

from dataclasses import dataclass
from uuid import UUID

from sqlalchemy import select

from services.cli.output import first_names
from services.cli.recovery.backup import (
    BackedUpObject,
    BackupFolder,
    BackupManifest,
    list_backup_objects,
)
from services.cli.recovery.journal_rows import Progress, RecoveryReport
from services.cli.recovery.rebuild import begin_rebuild, rebuild_catalog
from shared.catalog.database.session import Catalog
from shared.catalog.installation import Installation
from shared.config.settings import Settings
from shared.errors import Conflict, Misconfigured, NotFound
from shared.storage import ObjectStore, OwnedStore
from shared.storage.copying import copy_object, hash_object
from shared.storage.ownership import read_owner, store_taken_error

MAX_NAMES_IN_ERROR = 5


@dataclass(frozen=True, slots=True)
class RestoreReport:
    """What was restored."""

    made_at: str
    """Time of the backup."""
    objects: int
    copied_objects: int
    """Objects that were copied; the others already existed in the store."""
    recovered: RecoveryReport


def open_backup(folder: BackupFolder) -> tuple[BackupManifest, dict[str, BackedUpObject]]:
    """Return the manifest of a finished backup, and its objects by key.

    Raises:
        Misconfigured: `no_backup`, and as `read_manifest`.
    """
    manifest = folder.read_manifest()
    if manifest is None:
        raise Misconfigured(
            "no_backup",
            f"{folder.path} has no finished backup (no backup.json). If a backup was interrupted, "
            "run `placewise storage backup` on it again.",
        )
    return manifest, folder.read_index(manifest.index)


def restore_backup(
    folder: BackupFolder,
    catalog: Catalog,
    store: OwnedStore,
    settings: Settings,
    progress: Progress = lambda what, done, total: None,
) -> RestoreReport:
    """Restore a backup into an empty catalog and an object store.

    Args:
        settings: as for `rebuild_catalog`.
        progress: called after each object and for the rows.

    Raises:
        Conflict: `target_not_empty`.
        Misconfigured: as `open_backup`; `bucket_taken`, `folder_taken` for the store of another
            catalog; `backup_damaged`.
    """
    manifest, index = open_backup(folder)
    mark = read_owner(store)
    with catalog.read() as session:
        own_id = session.scalar(select(Installation.id))
    if mark not in (None, manifest.installation_id, str(own_id)):
        raise store_taken_error(store, "belongs to another catalog than this one")
    unknown_key = next((i.key for i in list_backup_objects(store) if i.key not in index), None)
    if unknown_key is not None:
        raise _not_empty_error(f"The object store has {unknown_key!r}, which is not in the backup.")
    try:
        begin_rebuild(catalog, store, UUID(mark or manifest.installation_id))
    except Conflict as error:
        raise _not_empty_error(error.detail) from error
    copied = _copy_objects(folder, index, store, progress)
    recovered = rebuild_catalog(catalog, store, settings, with_unnamed=False, progress=progress)
    return RestoreReport(manifest.made_at, len(index), copied, recovered)


def _not_empty_error(reason: str) -> Conflict:
    return Conflict(
        "target_not_empty",
        "A backup can only be restored into an empty Placewise. Set another PLACEWISE_HOME, or a "
        f"new database (DATABASE_URL) and an empty bucket (S3_BUCKET). {reason}",
    )


def _copy_objects(
    folder: BackupFolder,
    index: dict[str, BackedUpObject],
    store: ObjectStore,
    progress: Progress,
) -> int:
    """Verify and copy the objects that the store lacks; return their number."""
    source, copied, damaged = folder.objects, 0, []
    for done, entry in enumerate(index.values(), start=1):
        existing = store.head(entry.key)
        if existing is None or existing.size_bytes != entry.size_bytes:
            try:
                if hash_object(source, entry.key) == (entry.size_bytes, entry.sha256):
                    copy_object(source, store, entry.key)
                    copied += 1
                else:
                    damaged.append(entry.key)
            except NotFound:
                damaged.append(entry.key)
        progress("objects", done, len(index))
    if damaged:
        names = first_names(damaged, MAX_NAMES_IN_ERROR)
        raise Misconfigured(
            "backup_damaged",
            f"{len(damaged)} objects of the backup are missing or damaged: {names}. Use another "
            "backup. To restore the rest without them, delete their lines from the file that "
            f"`index` in {folder.path / 'backup.json'} names, and run `placewise storage verify "
            "--repair` afterwards.",
        )
    return copied
