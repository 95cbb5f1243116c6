"""`placewise storage backup`, `restore` and `rebuild`.

A backup is a copy of the object store, and a restore ends with a rebuild of the catalog from it.
That is imported where it is used: it reads photos, whose libraries not every image contains.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from uuid import UUID

import typer
from rich.markup import escape

from services.cli.environment import read_settings
from services.cli.output import (
    JsonOption,
    err_console,
    first_names,
    print_json,
    print_message,
    print_note,
    progress_bar,
    refuse_unwritable,
    stage_bars,
)
from services.cli.recovery.backup import BackupFolder, create_backup
from shared.catalog.database.schema import check_schema, migrate, opening
from shared.catalog.database.session import NO_TIMEOUTS, Catalog
from shared.catalog.installation import get_or_create_installation, open_installation_store
from shared.catalog.tables import open_catalog
from shared.config.embedded_home import lock_home
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.storage import OwnedStore
from shared.storage.open_store import open_store
from shared.storage.ownership import read_owner

if TYPE_CHECKING:
    from services.cli.recovery.journal_rows import RecoveryReport

MAX_KEYS_SHOWN = 10


@contextlib.contextmanager
def open_storage(settings: Settings, command: str) -> Iterator[tuple[Catalog, OwnedStore]]:
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
    with progress_bar() as bars, open_storage(read_settings(), "backup") as (catalog, store):
        with catalog.write() as session:
            installation_id = get_or_create_installation(session).id
        with refuse_unwritable(out):
            manifest = create_backup(catalog, store, installation_id, out, stage_bars(bars))
    if as_json:
        print_json(asdict(manifest))
    else:
        print_message(
            f"Backed up {manifest.photos} photos in {manifest.objects} objects "
            f"({manifest.object_bytes / 1e6:.1f} MB) to {out!s} as of {manifest.made_at}"
        )
        for state, keys in (("missing", manifest.missing), ("damaged", manifest.damaged)):
            for key in keys[:MAX_KEYS_SHOWN]:
                err_console.print(f"[red]{state}[/red] {escape(key)}", soft_wrap=True)
            if len(keys) > MAX_KEYS_SHOWN:
                print_note(f"{len(keys)} objects are {state}. backup.json lists all of them.")
    if manifest.missing or manifest.damaged:
        print_note("Run `placewise storage verify` for details and remedies.")
        raise typer.Exit(1)


def restore(
    source: Annotated[Path, typer.Argument(metavar="FROM", help="Folder of a backup.")],
    as_json: JsonOption = False,
) -> None:
    """Restore a backup into an empty installation. Stop its services first.

    An interrupted restore resumes when the command is run again.
    """
    from services.cli.recovery.restore import open_backup, restore_backup

    settings, folder = read_settings(), BackupFolder(source)
    with contextlib.ExitStack() as stack:
        bars = stack.enter_context(progress_bar())
        open_backup(folder)  # before anything is created
        if os.access(source, os.W_OK):  # a read-only folder has no concurrent writer
            stack.enter_context(folder.lock())
        catalog, store = stack.enter_context(_open_new_catalog(settings, "restore"))
        restored = restore_backup(folder, catalog, store, settings, stage_bars(bars))
    if as_json:
        print_json(asdict(restored))
        return
    print_message(f"Restored {restored.objects} objects as of {restored.made_at}.")
    print_recovered(restored.recovered)


def rebuild_catalog(as_json: JsonOption = False) -> None:
    """Rebuild a lost catalog from the object store. Stop all services first.

    Recovers photos with their metadata, maps, generations, vocabularies, API keys and webhooks. An
    interrupted rebuild resumes when the command is run again.
    """
    from services.cli.recovery import rebuild

    settings = read_settings()
    with progress_bar() as bars, _open_new_catalog(settings, "rebuild") as (catalog, store):
        mark = read_owner(store)
        rebuild.begin_rebuild(catalog, store, UUID(mark) if mark else None)
        recovered = rebuild.rebuild_catalog(
            catalog, store, settings, with_unnamed=True, progress=stage_bars(bars)
        )
    if as_json:
        print_json(asdict(recovered))
        return
    print_recovered(recovered)
    print_note(
        "Unfinished batches and model changes, and the search history and tracks of the last hour, "
        "may be missing."
    )


def print_recovered(report: RecoveryReport) -> None:
    """Print what was recovered into the catalog and what was not."""
    print_message(
        f"Recovered {report.photos + report.unnamed_photos} photos in {report.maps} maps, with "
        f"{report.descriptors} descriptors in {report.chunks} chunks, {report.generations} "
        f"generations and {report.vocabularies} vocabularies. {report.queued_photos} photos are "
        "queued for description."
    )
    for old, new in report.renamed_maps.items():
        print_note(f"Two maps were named {old}. The second one was renamed to {new}.")
    if report.unnamed_photos:
        print_note(
            f"{report.unnamed_photos} photos are not in the journal. They were added to the map "
            "default with coordinates, heading and time from EXIF. Their file names, place labels, "
            "tags, metadata, roles and maps, and values that overrode EXIF, are lost."
        )
    if report.unnamed_descriptors:
        print_note(
            f"{report.unnamed_descriptors} descriptors belong to generations that are not in the "
            "journal and can't be assigned to photos."
        )
    if report.lost_originals:
        print_note(
            f"{report.lost_originals} photos of the journal have no original in the store and were "
            "not recovered: they were deleted just before the catalog was lost, or their files are "
            "missing."
        )
    if report.doubled_photos:
        print_note(f"{report.doubled_photos} photos are already stored under another ID.")
    for problem, keys in (
        ("journal segments can't be read. Restore them from a backup", report.damaged_segments),
        ("chunks are damaged. Their photos will be described again", report.damaged_chunks),
        ("originals can't be decoded and were not recovered", report.unreadable_originals),
    ):
        if keys:
            print_note(f"{len(keys)} {problem}: {first_names(keys, MAX_KEYS_SHOWN)}")
