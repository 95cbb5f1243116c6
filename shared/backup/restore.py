"""Making an empty Placewise what a backup holds.

Objects come first, then all rows in one transaction: a restore that is interrupted has no row yet,
and goes on with the objects that it lacks.
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
    copy_object,
    hash_object,
    list_backup_objects,
    load_rows,
)
from shared.catalog.installation import get_or_create_installation
from shared.catalog.jobs import MODEL_CHANGE_JOBS, QUERY_JOBS, UNFINISHED_STATES, Job
from shared.catalog.maps import DEFAULT_MAP, Map
from shared.catalog.processes import RegisteredSearchWorker
from shared.catalog.session import NO_TIMEOUTS, Catalog
from shared.errors import Conflict, Misconfigured, NotFound
from shared.jobs.model_changes import cancel_model_change
from shared.jobs.transitions import cancel_job, release_job
from shared.storage import ObjectStore

MAX_NAMES_IN_ERROR = 5


@dataclass(frozen=True, slots=True)
class RestoreResult:
    rows: int
    objects: int
    copied_objects: int
    """The others were there already: of a restore that was interrupted, or in the same bucket."""
    cancelled_jobs: int
    """Queries, and fits whose half-done work a backup does not hold."""


def restore_backup(
    folder: BackupFolder,
    about: BackupManifest,
    catalog: Catalog,
    open_store: Callable[[], ObjectStore],
    import_prefix: str,
    progress: BackupProgress = lambda what, done, total: None,
    *,
    store_owner: str | None = None,
) -> RestoreResult:
    """The catalog, its schema up to date, and the store become what the backup holds.

    `store_owner` is the installation id that the store is marked with, None for a store without a
    mark. `open_store` is called once the catalog has the backup's installation id, or has kept its
    own because the store is marked with that. Raises Conflict
    (`target_not_empty`) where something else lies, and Misconfigured: `backup_of_another_release`,
    `backup_damaged` (the target then stays without rows).
    """
    unlimited = catalog.with_timeouts(NO_TIMEOUTS)
    with unlimited.write() as session:
        _check_schema(session, about)
        _check_catalog_empty(session)
        installation = get_or_create_installation(session)
        if installation.bucket is None and store_owner != str(installation.id):
            installation.id = UUID(about.installation_id)
    store = open_store()
    strange = next(
        (i.key for i in list_backup_objects(store, import_prefix) if i.key not in folder.index),
        None,
    )
    if strange is not None:
        raise _not_empty_error(f"the object store has {strange!r}, which the backup does not know")
    copied = _copy_objects(folder, store, progress)
    with unlimited.write() as session:
        _check_catalog_empty(session)
        session.execute(delete(RegisteredSearchWorker))
        session.execute(delete(Map))
        load_rows(session, folder.path / about.catalog, about.rows, progress)
        session.flush()
        # Else the restored catalog would take the journal's segments for a later catalog's.
        get_or_create_installation(session).journal_sequence = about.journal_sequence
        cancelled = _cancel_unfinished_work(session)
    rows = sum(count for name, count in about.rows.items() if name not in NOT_RESTORED_TABLES)
    return RestoreResult(rows, len(folder.index), copied, cancelled)


def _check_schema(session: Session, about: BackupManifest) -> None:
    present = str(session.scalar(text("SELECT version_num FROM alembic_version")))
    if present != about.schema:
        raise Misconfigured(
            "backup_of_another_release",
            f"The backup's schema is {about.schema}, this release's is {present}. Restore it with "
            f"the release that made it ({about.release}), then upgrade.",
        )


def _check_catalog_empty(session: Session) -> None:
    """Empty: as `placewise migrate`, or a first start, has left it."""
    for table in backup_tables():
        if table.name in (*NOT_RESTORED_TABLES, Map.__tablename__):
            continue
        if session.execute(select(table).limit(1)).first() is not None:
            raise _not_empty_error(f"its table {table.name} has rows")
    if any(name != DEFAULT_MAP for name in session.scalars(select(Map.name))):
        raise _not_empty_error("it has maps")


def _not_empty_error(why: str) -> Conflict:
    return Conflict(
        "target_not_empty",
        f"A backup is restored into an empty Placewise only, and this one is not: {why}. Give "
        "another PLACEWISE_HOME, or a new database (DATABASE_URL) and an empty bucket (S3_BUCKET).",
    )


def _copy_objects(folder: BackupFolder, store: ObjectStore, progress: BackupProgress) -> int:
    """Every object that is not there yet, checked against its hash; how many those were."""
    source, copied, bad = folder.objects, 0, []
    for done, kept in enumerate(folder.index.values(), start=1):
        there = store.head(kept.key)
        if there is None or there.size_bytes != kept.size_bytes:
            try:
                if hash_object(source, kept.key) != (kept.size_bytes, kept.sha256):
                    bad.append(kept.key)
                else:
                    copy_object(source, store, kept.key)
                    copied += 1
            except NotFound:
                bad.append(kept.key)
        progress("objects", done, len(folder.index))
    if bad:
        named = ", ".join(bad[:MAX_NAMES_IN_ERROR]) + (
            " ..." if len(bad) > MAX_NAMES_IN_ERROR else ""
        )
        raise Misconfigured(
            "backup_damaged",
            f"{len(bad)} objects of the backup are gone or changed: {named}. Take another backup. "
            "To restore the rest without them: delete their lines from objects.jsonl, and run "
            "`placewise verify --repair` afterwards.",
        )
    return copied


def _cancel_unfinished_work(session: Session) -> int:
    """Nobody works on anything here yet. What can't go on is cancelled; how many jobs."""
    for job in session.scalars(select(Job).where(Job.lease_token.is_not(None))).all():
        release_job(job)
    lost = session.scalars(
        select(Job).where(
            Job.state.in_(UNFINISHED_STATES),
            Job.kind.in_(QUERY_JOBS)
            | (Job.kind.in_(MODEL_CHANGE_JOBS) & Job.generation_id.is_(None)),
        )
    ).all()
    for job in lost:
        cancel_job(job) if job.kind in QUERY_JOBS else cancel_model_change(session, job)
    return len(lost)
