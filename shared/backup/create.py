"""Making a backup of a Placewise that runs."""

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
from shared.catalog.base import db_now
from shared.catalog.installation import Installation
from shared.catalog.session import NO_TIMEOUTS, Catalog
from shared.errors import Misconfigured, NotFound, Unavailable
from shared.integrity.referenced_objects import list_referenced_objects
from shared.storage import ObjectStore
from shared.storage.keys import JOURNAL

MAX_COPY_PASSES = 5  # of reading the catalog anew because something it named went away meanwhile


def create_backup(
    catalog: Catalog,
    store: ObjectStore,
    installation_id: UUID,
    path: Path,
    import_prefix: str,
    progress: BackupProgress = lambda what, done, total: None,
) -> BackupManifest:
    """Bring the folder `path` to what the service is now; what is there already is not copied
    again, whether it is of an earlier backup or of one that was interrupted.

    Until the end, the earlier backup in the folder stays whole. Raises Misconfigured:
    `not_a_backup`, `other_installation` for the backup of another Placewise; Conflict
    `backup_in_use`; Unavailable where a part is away, and `backup_overtaken` when what the catalog
    names goes away faster than it is copied.
    """
    folder = BackupFolder(path)
    folder.open_for_writing()
    with folder.exclusive_lock():
        before = folder.about()
        if before is not None and before.installation_id != str(installation_id):
            raise Misconfigured(
                "other_installation",
                f"{path} holds a backup of another Placewise. Give each a folder of its own.",
            )
        seen = _copy_all(store, folder, import_prefix, progress)
        unlimited = catalog.with_timeouts(NO_TIMEOUTS)
        for _ in range(MAX_COPY_PASSES):
            with unlimited.read() as session:
                # The first statement fixes what is seen.
                now = session.execute(select(db_now())).scalar_one()
                name = f"catalog-{now:%Y%m%dT%H%M%S%f}"
                counts = dump_rows(session, path / name, progress)
                schema = _revision(session)
                named = {found.key: found for found in list_referenced_objects(session)}
                sequence = session.scalar(select(Installation.journal_sequence)) or 0
            # Read after the catalog: it holds all that the catalog's rows are marked as journaled.
            journal = {info.key for info in store.list(JOURNAL)}
            gone = _copy_missing(store, folder, [*named, *journal], progress)
            missing = _still_referenced(unlimited, gone)
            if missing == gone:
                break
        else:
            raise Unavailable(
                "backup_overtaken",
                "What the catalog names is deleted or merged faster than it can be copied. Run the "
                "backup again: what is copied stays, and the next one is shorter.",
            )
        damaged = sorted(
            key
            for key, found in named.items()
            if found.sha256 is not None
            and key in folder.index
            and folder.index[key].sha256 != found.sha256
        )
        keep = (seen | named.keys() | journal) & folder.index.keys()
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


def _copy_all(
    store: ObjectStore, folder: BackupFolder, import_prefix: str, progress: BackupProgress
) -> set[str]:
    """Every object as it is now; the keys."""
    there = list(list_backup_objects(store, import_prefix))
    for done, info in enumerate(there, start=1):
        if not is_backed_up(folder, info):
            with contextlib.suppress(NotFound):  # deleted since it was listed
                back_up_object(store, folder, info)
        progress("objects", done, len(there))
    return {info.key for info in there}


def _copy_missing(
    store: ObjectStore, folder: BackupFolder, named: list[str], progress: BackupProgress
) -> set[str]:
    """What is named and not there yet; the keys of those that the store does not have."""
    rest = [key for key in named if key not in folder.index]
    gone = set()
    for done, key in enumerate(rest, start=1):
        info = store.head(key)
        try:
            if info is None:
                gone.add(key)
            else:
                back_up_object(store, folder, info)
        except NotFound:
            gone.add(key)
        progress("objects that came meanwhile", done, len(rest))
    return gone


def _still_referenced(catalog: Catalog, gone: set[str]) -> set[str]:
    """Those that are named even now: they are lost, not overtaken."""
    if not gone:
        return set()
    with catalog.read() as session:
        return {found.key for found in list_referenced_objects(session) if found.key in gone}


def _revision(session: Session) -> str:
    return str(session.scalar(text("SELECT version_num FROM alembic_version")))
