"""Creates and updates a backup of a running Placewise."""

from __future__ import annotations

import contextlib
from importlib.metadata import version
from pathlib import Path
from uuid import UUID

from sqlalchemy import select, text
from sqlalchemy.orm import Session

from shared.backup.folder import (
    BackupFolder,
    BackupManifest,
    BackupProgress,
    back_up_object,
    dump_rows,
    is_backed_up,
    list_backup_objects,
)
from shared.catalog.database.base import db_now
from shared.catalog.database.session import NO_TIMEOUTS, Catalog
from shared.catalog.installation import Installation
from shared.errors import Misconfigured, NotFound, Unavailable
from shared.integrity.referenced_objects import list_referenced_objects
from shared.storage import ObjectStore
from shared.storage.keys import JOURNAL

MAX_COPY_PASSES = 5  # snapshots of the catalog, when referenced objects are deleted meanwhile


def create_backup(
    catalog: Catalog,
    store: ObjectStore,
    installation_id: UUID,
    path: Path,
    progress: BackupProgress = lambda what, done, total: None,
) -> BackupManifest:
    """Create or update the backup in the folder `path`.

    Objects of an earlier or interrupted backup in the folder are not copied again. The earlier
    backup stays complete until the new one is finished.

    Args:
        progress: called after each object and for the rows.

    Raises:
        Misconfigured: `not_a_backup`; `other_installation` for the backup of another Placewise.
        Conflict: `backup_in_use`.
        Unavailable: the catalog or the store is unavailable; `backup_overtaken` when referenced
            objects are deleted faster than they are copied.
    """
    folder = BackupFolder(path)
    folder.open_for_writing()
    with folder.exclusive_lock():
        previous = folder.about()
        if previous is not None and previous.installation_id != str(installation_id):
            raise Misconfigured(
                "other_installation",
                f"{path} has a backup of another Placewise. Use a separate folder for each.",
            )
        copied = _copy_all(store, folder, progress)
        unlimited = catalog.with_timeouts(NO_TIMEOUTS)
        for _ in range(MAX_COPY_PASSES):
            with unlimited.read() as session:
                # The first statement starts the snapshot.
                now = session.execute(select(db_now())).scalar_one()
                name = f"catalog-{now:%Y%m%dT%H%M%S%f}"
                counts = dump_rows(session, path / name, progress)
                schema = _revision(session)
                referenced = {r.key: r for r in list_referenced_objects(session)}
                sequence = session.scalar(select(Installation.journal_sequence)) or 0
            # Listed after the snapshot: it has every state that the rows are marked as journaled.
            journal = {info.key for info in store.list(JOURNAL)}
            deleted = _copy_missing(store, folder, [*referenced, *journal], progress)
            missing = _still_referenced(unlimited, deleted)
            if missing == deleted:
                break
        else:
            raise Unavailable(
                "backup_overtaken",
                "Objects are deleted or merged faster than they can be copied. Run the backup "
                "again: it keeps the copied objects and has less to copy.",
            )
        damaged = sorted(
            key
            for key, expected in referenced.items()
            if expected.sha256 is not None
            and key in folder.index
            and folder.index[key].sha256 != expected.sha256
        )
        keep = (copied | referenced.keys() | journal) & folder.index.keys()
        about = BackupManifest(
            installation_id=str(installation_id),
            schema=schema,
            release=version("placewise"),
            made_at=now.isoformat(),
            catalog=name,
            rows=counts,
            objects=len(keep),
            object_bytes=sum(folder.index[key].size_bytes for key in keep),
            missing=sorted(missing),
            damaged=damaged,
            journal_sequence=sequence,
        )
        folder.finish(about, keep)
        return about


def _copy_all(store: ObjectStore, folder: BackupFolder, progress: BackupProgress) -> set[str]:
    """Copy every object that is new or has changed; return the keys of all."""
    objects = list(list_backup_objects(store))
    for done, info in enumerate(objects, start=1):
        if not is_backed_up(folder, info):
            with contextlib.suppress(NotFound):  # deleted since it was listed
                back_up_object(store, folder, info)
        progress("objects", done, len(objects))
    return {info.key for info in objects}


def _copy_missing(
    store: ObjectStore, folder: BackupFolder, keys: list[str], progress: BackupProgress
) -> set[str]:
    """Copy the objects that the backup lacks; return the keys that the store does not have."""
    missing = [key for key in keys if key not in folder.index]
    deleted = set()
    for done, key in enumerate(missing, start=1):
        info = store.head(key)
        try:
            if info is None:
                deleted.add(key)
            else:
                back_up_object(store, folder, info)
        except NotFound:
            deleted.add(key)
        progress("new objects", done, len(missing))
    return deleted


def _still_referenced(catalog: Catalog, keys: set[str]) -> set[str]:
    """Return the keys that the catalog still references: their objects are lost."""
    if not keys:
        return set()
    with catalog.read() as session:
        return {r.key for r in list_referenced_objects(session) if r.key in keys}


def _revision(session: Session) -> str:
    return str(session.scalar(text("SELECT version_num FROM alembic_version")))
