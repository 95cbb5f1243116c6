"""`placewise backup`, `restore` and `rebuild-catalog`.

A backup is a folder with the catalog's rows and the objects that they refer to. `rebuild-catalog`
recovers a lost catalog from the object store alone. `open_storage` gives other maintenance commands
access to the catalog and the store.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from sqlalchemy.exc import SQLAlchemyError

from services.cli.environment import read_settings
from services.cli.output import (
    JsonOption,
    console,
    err_console,
    print_json,
    print_result,
    progress_bar,
    report_errors,
)
from shared.backup.create import create_backup
from shared.backup.folder import BackupProgress, open_backup
from shared.backup.restore import restore_backup
from shared.catalog.database_errors import explain_outage
from shared.catalog.installation import get_or_create_installation, open_installation_store
from shared.catalog.schema import check_schema, migrate, opening
from shared.catalog.session import NO_TIMEOUTS, Catalog
from shared.catalog.tables import open_catalog
from shared.config.embedded_home import lock_home
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.storage import OwnedStore
from shared.storage.open_store import open_store
from shared.storage.ownership import read_owner

if TYPE_CHECKING:
    from shared.rebuild.recover import RecoveryReport


@contextlib.contextmanager
def open_storage(settings: Settings, command: str) -> Iterator[tuple[Catalog, OwnedStore]]:
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


MAX_KEYS_SHOWN = 10


def backup(
    out: Annotated[
        Path, typer.Argument(help="Folder of the backup. Later runs copy only changes.")
    ],
    as_json: JsonOption = False,
) -> None:
    """Back up the catalog and the object store to a folder while services run.

    The exit code is 1 if an object that the catalog refers to is missing or damaged. The backup
    then contains everything else.
    """
    with report_errors(as_json), progress_reporter() as progress:
        settings = read_settings()
        with open_storage(settings, "backup") as (catalog, store):
            with catalog.write() as session:
                installation_id = get_or_create_installation(session).id
            manifest = create_backup(
                catalog, store, installation_id, out, settings.import_prefix, progress
            )
    if as_json:
        print_json(asdict(manifest))
    else:
        console.print(
            f"Backed up {sum(manifest.rows.values())} rows and {manifest.objects} objects "
            f"({manifest.object_bytes / 1e6:.1f} MB) to {escape(str(out))} as of "
            f"{manifest.made_at}",
            soft_wrap=True,
        )
        for state, keys in (("missing", manifest.missing), ("damaged", manifest.damaged)):
            for key in keys[:MAX_KEYS_SHOWN]:
                err_console.print(f"[red]{state}[/red] {escape(key)}", soft_wrap=True)
            if len(keys) > MAX_KEYS_SHOWN:
                err_console.print(
                    f"{len(keys)} objects are {state}. backup.json lists all of them."
                )
    if manifest.missing or manifest.damaged:
        err_console.print("Run `placewise verify` for details and remedies.")
        raise typer.Exit(1)


def restore(
    source: Annotated[Path, typer.Argument(metavar="FROM", help="Folder of a backup.")],
    as_json: JsonOption = False,
) -> None:
    """Restore a backup into an empty installation. Stop its services first.

    An interrupted restore resumes when the command is run again.
    """
    with report_errors(as_json), progress_reporter() as progress, contextlib.ExitStack() as stack:
        settings = read_settings()
        folder, manifest = open_backup(source)
        if settings.database_url is None:
            stack.enter_context(lock_home(settings.placewise_home))
        if os.access(source, os.W_OK):  # a read-only folder has no concurrent writer
            stack.enter_context(folder.exclusive_lock())
        catalog = open_catalog(settings, "restore")
        stack.callback(catalog.close)
        migrate(catalog)
        exclusive = settings.database_url is None
        restored = restore_backup(
            folder,
            manifest,
            catalog,
            lambda: open_installation_store(catalog, settings, exclusive=exclusive),
            settings.import_prefix,
            progress,
            store_owner=read_owner(open_store(settings, exclusive=False)),
        )
    print_result(
        asdict(restored),
        as_json,
        f"Restored {restored.rows} rows and {restored.objects} objects as of {manifest.made_at}"
        + (f"; cancelled {restored.cancelled_jobs} jobs" if restored.cancelled_jobs else ""),
    )


@contextlib.contextmanager
def progress_reporter() -> Iterator[BackupProgress]:
    """Show a progress bar per stage."""
    with progress_bar() as bars:
        yield _make_reporter(bars.add_task, bars.update)


def _make_reporter(
    add_task: Callable[..., object], update: Callable[..., object]
) -> BackupProgress:
    tasks: dict[str, object] = {}

    def report(stage: str, done: int, total: int) -> None:
        if stage not in tasks:
            tasks[stage] = add_task(stage, total=total)
        update(tasks[stage], completed=done, total=total)

    return report


NOT_RECOVERED_NOTE = (
    "API keys, webhooks, jobs, the search history and evaluation reports are not stored in the "
    "object store. Create keys and webhooks again."
)


def rebuild_catalog(as_json: JsonOption = False) -> None:
    """Rebuild a lost catalog from the object store. Stop all services first.

    Recovers photos with their metadata, maps, generations and vocabularies. An interrupted rebuild
    resumes when the command is run again.
    """
    with report_errors(as_json), progress_reporter() as progress, contextlib.ExitStack() as stack:
        # Imported here: it decodes photos, whose libraries not every image contains.
        from shared.rebuild.recover import begin_rebuild, recover_catalog

        settings = read_settings()
        exclusive = settings.database_url is None
        if exclusive:
            stack.enter_context(lock_home(settings.placewise_home))
        catalog = open_catalog(settings, "rebuild-catalog", NO_TIMEOUTS)
        stack.callback(catalog.close)
        migrate(catalog)
        begin_rebuild(catalog, open_store(settings, exclusive=exclusive))
        store = open_installation_store(catalog, settings, exclusive=exclusive)
        taken = recover_catalog(
            catalog, store, settings, unnamed_age_seconds=0.0, progress=progress
        )
    if as_json:
        print_json(asdict(taken))
        return
    print_taken_in(taken)
    err_console.print(NOT_RECOVERED_NOTE, soft_wrap=True)


def print_taken_in(taken: RecoveryReport) -> None:
    """Print what was recovered into the catalog and what was not."""
    console.print(
        f"Recovered {taken.photos + taken.unnamed_photos} photos in {taken.maps} new maps, with "
        f"{taken.descriptors} descriptors in {taken.chunks} chunks, {taken.generations} "
        f"generations and {taken.vocabularies} vocabularies. {taken.queued_photos} photos are "
        "queued for description.",
        soft_wrap=True,
    )
    if taken.changed_photos or taken.deleted_photos:
        console.print(
            f"The journal's changes were applied: {taken.changed_photos} photos updated, "
            f"{taken.deleted_photos} deleted."
        )
    for old, new in taken.renamed_maps.items():
        err_console.print(
            f"Another map is named {escape(old)}. The journal's map was renamed to {new}."
        )
    if taken.unnamed_photos:
        err_console.print(
            f"{taken.unnamed_photos} photos are not in the journal. They were added to the map "
            "default with coordinates, heading and time from EXIF. Their file names, place labels, "
            "tags, metadata, roles and maps, and values that overrode EXIF, are lost.",
            soft_wrap=True,
        )
    if taken.unnamed_descriptors:
        err_console.print(
            f"{taken.unnamed_descriptors} descriptors belong to generations that are not in the "
            "journal and can't be assigned to photos.",
            soft_wrap=True,
        )
    if taken.lost_originals:
        err_console.print(
            f"{taken.lost_originals} photos of the journal have no original in the store and were "
            "not recovered: they were deleted just before the catalog was lost, or their files are "
            "missing.",
            soft_wrap=True,
        )
    if taken.doubled_photos:
        err_console.print(f"{taken.doubled_photos} photos are already stored under another ID.")
    for problem, keys in (
        ("journal segments can't be read. Restore them from a backup", taken.damaged_segments),
        ("chunks are damaged. Their photos will be described again", taken.damaged_chunks),
        ("originals can't be decoded and were not recovered", taken.unreadable_originals),
    ):
        if keys:
            listed = ", ".join(keys[:MAX_KEYS_SHOWN])
            listed += " ..." if len(keys) > MAX_KEYS_SHOWN else ""
            err_console.print(f"{len(keys)} {problem}: {escape(listed)}", soft_wrap=True)
