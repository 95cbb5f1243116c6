"""Backup, recovery and repair of an installation, on its catalog and its object store directly.

The commands in `backup` and `storage` import this module when they run. The rebuild is imported
where it is used: it reads photos, whose libraries not every image contains.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import UUID

from services.cli.recovery.backup import (
    BackupFolder,
    BackupManifest,
    BackupProgress,
    create_backup,
)
from services.steward.tasks.orphans import StoreCount, collect_orphans, find_orphans
from shared.catalog.database.schema import check_schema, migrate, opening
from shared.catalog.database.session import NO_TIMEOUTS, Catalog
from shared.catalog.installation import (
    get_or_create_installation,
    open_installation_store,
)
from shared.catalog.tables import open_catalog
from shared.config.embedded_home import lock_home
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.integrity.verify import IntegrityReport, repair_descriptors, verify_store
from shared.jobs import InProcessWakeups
from shared.storage import OwnedStore
from shared.storage.keys import TRASH
from shared.storage.open_store import open_store
from shared.storage.ownership import read_owner
from shared.storage.trash import read_hold, restore_trash
from shared.telemetry.logs import configure_logging

if TYPE_CHECKING:
    from services.cli.recovery.journal_rows import RecoveryReport
    from services.cli.recovery.restore import RestoreReport


def migrate_catalog(settings: Settings) -> UUID:
    """Create the catalog's tables; return the id of the installation."""
    configure_logging(settings, "migrate")
    with contextlib.closing(open_catalog(settings, "migrate")) as catalog:
        migrate(catalog)
        with catalog.write() as session:
            return get_or_create_installation(session).id


@contextlib.contextmanager
def _open_storage(settings: Settings, command: str) -> Iterator[tuple[Catalog, OwnedStore]]:
    """Open the catalog and the object store, whether or not services are running."""
    if settings.database_url is None and not (settings.placewise_home / "catalog.sqlite").exists():
        raise Misconfigured(
            "nothing_stored",
            f"No catalog found in {settings.placewise_home}. Set PLACEWISE_HOME to the folder of "
            "the installation, or set DATABASE_URL.",
        )
    with contextlib.closing(open_catalog(settings, command, NO_TIMEOUTS)) as catalog:
        with opening(catalog):
            check_schema(catalog)
        yield catalog, open_installation_store(catalog, settings, exclusive=False)


def back_up(settings: Settings, out: Path, progress: BackupProgress) -> BackupManifest:
    """Create or update the backup in the folder `out`."""
    with _open_storage(settings, "backup") as (catalog, store):
        with catalog.write() as session:
            installation_id = get_or_create_installation(session).id
        return create_backup(catalog, store, installation_id, out, progress)


@contextlib.contextmanager
def _open_new_catalog(settings: Settings, command: str) -> Iterator[tuple[Catalog, OwnedStore]]:
    """Open the catalog, with its tables created, and a store that may not be its own yet."""
    exclusive = settings.database_url is None
    with contextlib.ExitStack() as stack:
        if exclusive:
            stack.enter_context(lock_home(settings.placewise_home))
        opened = open_catalog(settings, command, NO_TIMEOUTS)
        catalog = stack.enter_context(contextlib.closing(opened))
        migrate(catalog)
        yield catalog, open_store(settings, exclusive=exclusive)


def restore(settings: Settings, source: Path, progress: BackupProgress) -> RestoreReport:
    """Restore the backup in the folder `source` into an empty installation."""
    from services.cli.recovery.restore import open_backup, restore_backup

    folder = BackupFolder(source)
    open_backup(folder)  # before anything is created
    with contextlib.ExitStack() as stack:
        if os.access(source, os.W_OK):  # a read-only folder has no concurrent writer
            stack.enter_context(folder.lock())
        catalog, store = stack.enter_context(_open_new_catalog(settings, "restore"))
        return restore_backup(folder, catalog, store, settings, progress)


def rebuild(settings: Settings, progress: BackupProgress) -> RecoveryReport:
    """Rebuild a lost catalog from the object store."""
    from services.cli.recovery.rebuild import begin_rebuild, rebuild_catalog

    with _open_new_catalog(settings, "rebuild") as (catalog, store):
        mark = read_owner(store)
        begin_rebuild(catalog, store, UUID(mark) if mark else None)
        return rebuild_catalog(catalog, store, settings, with_unnamed=True, progress=progress)


def verify_storage(
    settings: Settings, progress: BackupProgress, *, originals: bool, repair: bool
) -> tuple[IntegrityReport, int | None]:
    """Check the object store against the catalog; also returns how many photos a repair queued."""
    with _open_storage(settings, "verify") as (catalog, store):
        report = verify_store(catalog, store, originals=originals, progress=progress)
        for info in find_orphans(catalog, store, age_seconds=0.0):
            report.orphans += 1
            report.orphan_bytes += info.size_bytes
            progress("orphaned objects", report.orphans, report.orphans)
        trash = [info.size_bytes for info in store.list(TRASH)]
        report.trash_objects, report.trash_bytes = len(trash), sum(trash)
        # No wakeup message is needed: workers poll, and the steward sends messages.
        queued = repair_descriptors(catalog, InProcessWakeups(), report) if repair else None
    return report, queued


def collect_storage(settings: Settings, *, confirm: bool) -> tuple[StoreCount, int, str | None]:
    """Count the store's orphans; with `confirm`, move them to the trash; return their number."""
    with _open_storage(settings, "storage") as (catalog, store):
        count, moved, hold = StoreCount(), 0, read_hold(store)
        for _ in find_orphans(catalog, store, settings.orphan_age_seconds, count):
            pass
        while confirm and (
            batch := collect_orphans(catalog, store, settings.orphan_age_seconds, confirmed=True)
        ):
            moved += batch
    return count, moved, hold


def restore_from_trash(settings: Settings, prefix: str) -> Counter[bool]:
    """Count restored objects (True), and those whose key is in use again (False)."""
    with _open_storage(settings, "storage") as (_, store):
        return Counter(was_restored for _, was_restored in restore_trash(store, prefix))
