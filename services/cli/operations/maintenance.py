"""Backup, recovery and repair of an installation, on its catalog and its object store directly.

The commands in `backup` and `storage` import this module when they run. `shared.rebuild` is
imported where it is used: it decodes photos, whose libraries not every image contains.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy.exc import SQLAlchemyError

from services.steward.tasks.orphans import StoreCount, collect_orphans, count_store, find_orphans
from shared.backup.create import create_backup
from shared.backup.folder import BackupManifest, BackupProgress, open_backup
from shared.backup.restore import RestoreResult, restore_backup
from shared.catalog.database.errors import explain_outage
from shared.catalog.database.schema import check_schema, migrate, opening
from shared.catalog.database.session import NO_TIMEOUTS, Catalog
from shared.catalog.installation import (
    adopt_store,
    get_or_create_installation,
    open_installation_store,
)
from shared.catalog.tables import open_catalog
from shared.config.embedded_home import find_running_server, lock_home
from shared.config.settings import Settings
from shared.errors import Conflict, Misconfigured
from shared.integrity.verify import IntegrityReport, repair_descriptors, verify_store
from shared.jobs import InProcessWakeups
from shared.journal.outbox import Lag, catalog_lag
from shared.storage import ObjectStore, OwnedStore
from shared.storage.open_store import open_store
from shared.storage.ownership import read_owner
from shared.storage.trash import (
    Hold,
    HoldReason,
    measure_trash,
    read_hold,
    restore_trash,
    write_hold,
)

if TYPE_CHECKING:
    from shared.rebuild.recover import RecoveryReport

UPLOAD_SECONDS = 3600.0  # an older original does not belong to an upload in progress


@contextlib.contextmanager
def _open_storage(settings: Settings, command: str) -> Iterator[tuple[Catalog, OwnedStore]]:
    """Open the catalog and the object store, whether or not services are running.

    Args:
        settings: Settings that locate both.
        command: Name of the command, shown as the database connection's application name.

    Raises:
        Misconfigured: `nothing_stored` if PLACEWISE_HOME contains no catalog, and the errors of
            `check_schema` and `open_installation_store`.
        Unavailable: The database or the object store can't be reached.
    """
    if settings.database_url is None and not (settings.placewise_home / "catalog.sqlite").exists():
        raise Misconfigured(
            "nothing_stored",
            f"No catalog found in {settings.placewise_home}. Set PLACEWISE_HOME to the folder of "
            "the installation, or set DATABASE_URL.",
        )
    catalog = open_catalog(settings, command, NO_TIMEOUTS)
    try:
        with opening(catalog):
            check_schema(catalog)
        yield catalog, open_installation_store(catalog, settings, exclusive=False)
    except SQLAlchemyError as error:
        unavailable = explain_outage(error)
        if unavailable is None:
            raise
        raise unavailable from error
    finally:
        catalog.close()


def back_up(settings: Settings, out: Path, progress: BackupProgress) -> BackupManifest:
    """Create or update the backup in the folder `out`; raises as `_open_storage` does."""
    with _open_storage(settings, "backup") as (catalog, store):
        with catalog.write() as session:
            installation_id = get_or_create_installation(session).id
        return create_backup(catalog, store, installation_id, out, progress)


def restore(
    settings: Settings, source: Path, progress: BackupProgress
) -> tuple[BackupManifest, RestoreResult]:
    """Restore the backup in the folder `source` into an empty installation.

    Raises:
        PlacewiseError: As `open_backup`, `lock_home`, `migrate` and `restore_backup` raise it.
    """
    exclusive = settings.database_url is None
    folder, manifest = open_backup(source)
    with contextlib.ExitStack() as stack:
        if exclusive:
            stack.enter_context(lock_home(settings.placewise_home))
        if os.access(source, os.W_OK):  # a read-only folder has no concurrent writer
            stack.enter_context(folder.exclusive_lock())
        catalog = stack.enter_context(contextlib.closing(open_catalog(settings, "restore")))
        migrate(catalog)
        restored = restore_backup(
            folder,
            manifest,
            catalog,
            lambda: open_installation_store(catalog, settings, exclusive=exclusive),
            progress,
            store_owner=read_owner(open_store(settings, exclusive=False)),
        )
    return manifest, restored


def rebuild(settings: Settings, progress: BackupProgress) -> RecoveryReport:
    """Rebuild a lost catalog from the object store.

    Raises:
        PlacewiseError: As `lock_home`, `migrate` and `begin_rebuild` raise it.
    """
    from shared.rebuild.recover import begin_rebuild, recover_catalog

    exclusive = settings.database_url is None
    with contextlib.ExitStack() as stack:
        if exclusive:
            stack.enter_context(lock_home(settings.placewise_home))
        catalog = stack.enter_context(
            contextlib.closing(open_catalog(settings, "rebuild", NO_TIMEOUTS))
        )
        migrate(catalog)
        begin_rebuild(catalog, open_store(settings, exclusive=exclusive))
        store = open_installation_store(catalog, settings, exclusive=exclusive)
        return recover_catalog(catalog, store, settings, unnamed_age_seconds=0.0, progress=progress)


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of `verify`."""

    report: IntegrityReport
    lag: Lag | None
    """How the catalog is behind the journal; None if it is up to date."""
    recovered: RecoveryReport | None
    """What a repair has recovered from the journal."""
    queued_photos: int | None
    """Photos that a repair has queued for description; None without a repair."""


def verify_storage(
    settings: Settings, progress: BackupProgress, *, originals: bool, repair: bool
) -> Verification:
    """Check the object store against the catalog; raises as `_open_storage` does.

    Args:
        settings: Settings that locate both.
        progress: Called with a stage, what is done, and the total.
        originals: Whether to check the hashes of the original photos, too.
        repair: Whether to queue photos of damaged chunks and to recover missing records.
    """
    with _open_storage(settings, "verify") as (catalog, store):
        lag, recovered = catalog_lag(catalog, store), None
        if lag is not None and repair:
            recovered = _recover_from_journal(catalog, store, settings, lag, progress)
        report = verify_store(catalog, store, originals=originals, progress=progress)
        for info in find_orphans(catalog, store, age_seconds=0.0):
            report.orphans += 1
            report.orphan_bytes += info.size_bytes
            progress("orphaned objects", report.orphans, report.orphans)
        trash = measure_trash(store)
        report.trash_objects, report.trash_bytes = trash.objects, trash.size_bytes
        # No wakeup message is needed: workers poll, and the steward sends messages.
        queued = repair_descriptors(catalog, InProcessWakeups(), report) if repair else None
    return Verification(report, lag, recovered, queued)


def _recover_from_journal(
    catalog: Catalog, store: ObjectStore, settings: Settings, lag: Lag, progress: BackupProgress
) -> RecoveryReport:
    if lag.since is None:
        raise Conflict("rebuild_unfinished", lag.detail)
    from shared.rebuild.recover import recover_catalog  # decodes photos: not in every image

    may_be_serving = settings.database_url is not None or find_running_server(
        settings.placewise_home
    )
    age_seconds = UPLOAD_SECONDS if may_be_serving else 0.0
    return recover_catalog(
        catalog, store, settings, unnamed_age_seconds=age_seconds, progress=progress
    )


def adopt_storage(settings: Settings, *, confirm: bool) -> StoreCount:
    """Count the store's objects and orphans; with `confirm`, make this catalog the store's owner.

    Raises:
        Conflict: `already_owner`.
    """
    with contextlib.ExitStack() as stack:
        if settings.database_url is None:
            stack.enter_context(lock_home(settings.placewise_home))
        catalog = stack.enter_context(
            contextlib.closing(open_catalog(settings, "storage", NO_TIMEOUTS))
        )
        store = open_store(settings, exclusive=False)
        store.check()
        if confirm and catalog.is_sqlite:
            migrate(catalog)
        is_new = catalog.is_sqlite and not Path(catalog.url.database or "").exists()
        if not is_new:
            check_schema(catalog)
            _check_not_owned(catalog, read_owner(store))
        count = count_store(None if is_new else catalog, store)
        unknown = count.orphans.total()
        if confirm:
            # The hold comes first: without it, this catalog's steward could collect the objects.
            if unknown:
                unknown_bytes = count.orphan_bytes.total()
                write_hold(store, Hold(HoldReason.ADOPTED, unknown, unknown_bytes, count.objects))
            adopt_store(catalog, store)
    return count


def _check_not_owned(catalog: Catalog, owner: str | None) -> None:
    with catalog.write() as session:
        installation_id = get_or_create_installation(session).id
    if owner == str(installation_id):
        raise Conflict("already_owner", "This catalog already owns the store.")


def collect_storage(settings: Settings, *, confirm: bool) -> tuple[StoreCount, int, Hold | None]:
    """Count the store's orphans; with `confirm`, move them to the trash.

    Returns:
        The counts, the number of moved objects, and the hold on garbage collection, if any.
    """
    with _open_storage(settings, "storage") as (catalog, store):
        count, moved, hold = StoreCount(), 0, read_hold(store)
        for _ in find_orphans(catalog, store, settings.orphan_age_seconds, count):
            pass
        if confirm:
            moved = collect_orphans(catalog, store, settings.orphan_age_seconds, confirmed=True)
    return count, moved, hold


def restore_from_trash(settings: Settings, prefix: str) -> Counter[bool]:
    """Move objects from the trash back to their keys.

    Returns:
        The number of restored objects (True), and of those whose key is in use again (False).
    """
    with _open_storage(settings, "storage") as (_, store):
        return Counter(was_restored for _, was_restored in restore_trash(store, prefix))
