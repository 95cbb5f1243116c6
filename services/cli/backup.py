"""`placewise backup` and `placewise restore`: a whole Placewise into a folder, and back."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from services.cli.configuration import read_settings
from services.cli.output import (
    JsonOption,
    console,
    err_console,
    print_json,
    progress_bar,
    report_errors,
)
from services.cli.stored import open_storage
from shared.backup.folder import open_backup
from shared.backup.make import create_backup
from shared.backup.restore import restore_backup
from shared.backup.rows import BackupProgress
from shared.catalog.installation import get_or_create_installation, open_installation_store
from shared.catalog.open_catalog import open_catalog
from shared.catalog.schema import migrate
from shared.home import lock_home
from shared.objects.open_store import open_store
from shared.objects.store_owner import read_owner

MAX_KEYS_SHOWN = 10


def backup(
    out: Annotated[Path, typer.Argument(help="Folder of the backup; only changes are copied.")],
    as_json: JsonOption = False,
) -> None:
    """Copy catalog and objects into a folder, while the service runs. Exit code 1 when something
    that the catalog names is missing or damaged; all the rest is there then."""
    with report_errors(as_json), progress_reporter() as progress:
        settings = read_settings()
        with open_storage(settings, "backup") as (catalog, store):
            with catalog.write() as session:
                installation_id = get_or_create_installation(session).id
            about = create_backup(
                catalog, store, installation_id, out, settings.import_prefix, progress
            )
    if as_json:
        print_json(asdict(about))
    else:
        console.print(
            f"{sum(about.rows.values())} rows and {about.objects} objects "
            f"({about.object_bytes / 1e6:.1f} MB) are in {escape(str(out))}, as of {about.made_at}",
            soft_wrap=True,
        )
        for what, keys in (("missing", about.missing), ("damaged", about.damaged)):
            for key in keys[:MAX_KEYS_SHOWN]:
                err_console.print(f"[red]{what}[/red] {escape(key)}", soft_wrap=True)
            if len(keys) > MAX_KEYS_SHOWN:
                err_console.print(f"{len(keys)} are {what}: backup.json names them all")
    if about.missing or about.damaged:
        err_console.print("`placewise verify` says more of what is wrong, and what to do.")
        raise typer.Exit(1)


def restore(
    source: Annotated[Path, typer.Argument(metavar="FROM", help="Folder of a backup.")],
    as_json: JsonOption = False,
) -> None:
    """Make the empty Placewise of the settings what the backup holds; stop its services first. What
    was interrupted goes on where it was."""
    with report_errors(as_json), progress_reporter() as progress, contextlib.ExitStack() as held:
        settings = read_settings()
        folder, about = open_backup(source)
        if settings.database_url is None:
            held.enter_context(lock_home(settings.placewise_home))
        if os.access(source, os.W_OK):  # else nobody can be writing there
            held.enter_context(folder.exclusive_lock())
        catalog = open_catalog(settings, "restore")
        held.callback(catalog.close)
        migrate(catalog)
        alone = settings.database_url is None
        restored = restore_backup(
            folder,
            about,
            catalog,
            lambda: open_installation_store(catalog, settings, exclusive=alone),
            settings.import_prefix,
            progress,
            store_owner=read_owner(open_store(settings, exclusive=False)),
        )
    if as_json:
        print_json(asdict(restored))
        return
    console.print(
        f"{restored.rows} rows and {restored.objects} objects of {about.made_at} are back"
        + (f"; {restored.cancelled_jobs} jobs were cancelled" if restored.cancelled_jobs else ""),
        soft_wrap=True,
    )


@contextlib.contextmanager
def progress_reporter() -> Iterator[BackupProgress]:
    """A bar for each thing that is being done, one after the other."""
    with progress_bar() as bars:
        yield _make_reporter(bars.add_task, bars.update)


def _make_reporter(
    add_task: Callable[..., object], update: Callable[..., object]
) -> BackupProgress:
    known: dict[str, object] = {}

    def tell(what: str, done: int, total: int) -> None:
        if what not in known:
            known[what] = add_task(what, total=total)
        update(known[what], completed=done, total=total)

    return tell
