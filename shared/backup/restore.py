"""Restores a backup into an empty Placewise.

Objects are copied first, then all rows are inserted in one transaction: an interrupted restore has
no rows yet, and can be repeated, which copies the missing objects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from uuid import UUID

from sqlalchemy import delete, select, text
from sqlalchemy.orm import Session

from shared.backup.folder import (
    NOT_RESTORED_TABLES,
    BackupFolder,
    BackupManifest,
    BackupProgress,
    backup_tables,
    list_backup_objects,
    load_rows,
)
from shared.catalog.database.session import NO_TIMEOUTS, Catalog
from shared.catalog.installation import get_or_create_installation
from shared.catalog.jobs import QUERY_JOBS, UNFINISHED_STATES, Job
from shared.catalog.maps import DEFAULT_MAP, Map
from shared.catalog.processes import RegisteredSearchWorker
from shared.errors import Conflict, Misconfigured, NotFound
from shared.jobs.transitions import cancel_job, requeue_job
from shared.storage import ObjectStore
from shared.storage.copying import copy_object, hash_object

MAX_NAMES_IN_ERROR = 5


@dataclass(frozen=True, slots=True)
class RestoreResult:
    """Counts of a restore."""

    rows: int
    objects: int
    copied_objects: int
    """Objects that were copied; the others already existed in the store."""
    cancelled_jobs: int
    """Queries, whose photos are not in the backup."""


def restore_backup(
    folder: BackupFolder,
    about: BackupManifest,
    catalog: Catalog,
    open_store: Callable[[], ObjectStore],
    progress: BackupProgress = lambda what, done, total: None,
    *,
    store_owner: str | None = None,
) -> RestoreResult:
    """Restore a backup into an empty catalog with the current schema, and an object store.

    Args:
        open_store: opens the target store. It is called when the catalog has the backup's
            installation id, or has kept its own because the store is marked with that.
        progress: called after each object and for the rows.
        store_owner: installation id that the store is marked with; None without a mark.

    Raises:
        Conflict: `target_not_empty`.
        Misconfigured: `backup_of_another_release`, `backup_damaged`; the target then has no rows.
    """
    unlimited = catalog.with_timeouts(NO_TIMEOUTS)
    with unlimited.write() as session:
        _check_schema(session, about)
        _check_catalog_empty(session)
        installation = get_or_create_installation(session)
        if installation.bucket is None and store_owner != str(installation.id):
            installation.id = UUID(about.installation_id)
    store = open_store()
    unknown_key = next(
        (i.key for i in list_backup_objects(store) if i.key not in folder.index),
        None,
    )
    if unknown_key is not None:
        raise _not_empty_error(f"the object store has {unknown_key!r}, which is not in the backup")
    copied = _copy_objects(folder, store, progress)
    with unlimited.write() as session:
        _check_catalog_empty(session)
        session.execute(delete(RegisteredSearchWorker))
        session.execute(delete(Map))
        load_rows(session, folder.path / about.catalog, about.rows, progress)
        session.flush()
        # Otherwise the restored catalog would appear to be older than the journal.
        get_or_create_installation(session).journal_sequence = about.journal_sequence
        cancelled = _cancel_unfinished_work(session)
    rows = sum(count for name, count in about.rows.items() if name not in NOT_RESTORED_TABLES)
    return RestoreResult(rows, len(folder.index), copied, cancelled)


def _check_schema(session: Session, about: BackupManifest) -> None:
    present = str(session.scalar(text("SELECT version_num FROM alembic_version")))
    if present != about.schema:
        raise Misconfigured(
            "backup_of_another_release",
            f"The backup has the schema {about.schema}, but this release has {present}. Restore it "
            f"with the release that created it ({about.release}), then upgrade.",
        )


def _check_catalog_empty(session: Session) -> None:
    """Raise Conflict unless the catalog is as after `storage migrate` or a first start."""
    for table in backup_tables():
        if table.name in (*NOT_RESTORED_TABLES, Map.__tablename__):
            continue
        if session.execute(select(table).limit(1)).first() is not None:
            raise _not_empty_error(f"its table {table.name} has rows")
    if any(name != DEFAULT_MAP for name in session.scalars(select(Map.name))):
        raise _not_empty_error("it has maps")


def _not_empty_error(reason: str) -> Conflict:
    return Conflict(
        "target_not_empty",
        f"A backup can only be restored into an empty Placewise, and this one is not: {reason}. "
        "Set another PLACEWISE_HOME, or a new database (DATABASE_URL) and an empty bucket "
        "(S3_BUCKET).",
    )


def _copy_objects(folder: BackupFolder, store: ObjectStore, progress: BackupProgress) -> int:
    """Verify and copy the objects that the store lacks; return their number."""
    source, copied, damaged = folder.objects, 0, []
    for done, entry in enumerate(folder.index.values(), start=1):
        existing = store.head(entry.key)
        if existing is None or existing.size_bytes != entry.size_bytes:
            try:
                if hash_object(source, entry.key) != (entry.size_bytes, entry.sha256):
                    damaged.append(entry.key)
                else:
                    copy_object(source, store, entry.key)
                    copied += 1
            except NotFound:
                damaged.append(entry.key)
        progress("objects", done, len(folder.index))
    if damaged:
        names = ", ".join(damaged[:MAX_NAMES_IN_ERROR]) + (
            " ..." if len(damaged) > MAX_NAMES_IN_ERROR else ""
        )
        raise Misconfigured(
            "backup_damaged",
            f"{len(damaged)} objects of the backup are missing or damaged: {names}. Use another "
            "backup. To restore the rest without them, delete their lines from objects.jsonl, and "
            "run `placewise verify --repair` afterwards.",
        )
    return copied


def _cancel_unfinished_work(session: Session) -> int:
    """Release all leases, and cancel queries, which have no photo now; return their number."""
    for job in session.scalars(select(Job).where(Job.lease_token.is_not(None))).all():
        requeue_job(job)
    queries = session.scalars(
        select(Job).where(Job.state.in_(UNFINISHED_STATES), Job.kind.in_(QUERY_JOBS))
    ).all()
    for job in queries:
        cancel_job(job)
    return len(queries)
