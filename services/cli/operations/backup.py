"""`placewise backup` and `placewise restore`: a whole Placewise into a folder, and back.

The catalog and the store of the settings, for commands that look at what is there.

`placewise rebuild-catalog`: a lost catalog from its object store.
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
    progress_bar,
    report_errors,
)
from shared.backup.create import create_backup
from shared.backup.folder import BackupProgress, open_backup
from shared.backup.restore import restore_backup
from shared.catalog.database_errors import to_unavailable
from shared.catalog.file_checks import opening
from shared.catalog.installation import get_or_create_installation, open_installation_store
from shared.catalog.schema import check_schema, migrate
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
    """Both, while the service runs or not.

    Raises Misconfigured: `nothing_stored` for a folder without a catalog, those of `check_schema`
    and of `open_installation_store`; Unavailable while one of them is away.
    """
    if settings.database_url is None and not (settings.placewise_home / "catalog.sqlite").exists():
        raise Misconfigured(
            "nothing_stored",
            f"There is no catalog in {settings.placewise_home}: give the PLACEWISE_HOME that is "
            "served, or DATABASE_URL.",
        )
    catalog = open_catalog(settings, command, NO_TIMEOUTS)
    try:
        with opening(catalog):
            check_schema(catalog)
        yield catalog, open_installation_store(catalog, settings, exclusive=False)
    except SQLAlchemyError as error:
        unavailable = to_unavailable(error)
        if unavailable is None:
            raise
        raise unavailable from error
    finally:
        catalog.close()


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


SHOWN = 10
NEVER_IN_THE_JOURNAL = (
    "API keys, webhooks, jobs, the search history and evaluations' reports are not in the object "
    "store: make keys and webhooks anew."
)


def rebuild_catalog(as_json: JsonOption = False) -> None:
    """Rebuild a lost catalog from the object store: photos with all that was said of them, maps,
    generations, vocabularies. Stop the services first. Interrupted, it goes on when run again."""
    with report_errors(as_json), progress_reporter() as progress, contextlib.ExitStack() as held:
        # Imported only here: it reads photos, which not every image can.
        from shared.rebuild.recover import begin_rebuild, recover_catalog

        settings = read_settings()
        alone = settings.database_url is None
        if alone:
            held.enter_context(lock_home(settings.placewise_home))
        catalog = open_catalog(settings, "rebuild-catalog", NO_TIMEOUTS)
        held.callback(catalog.close)
        migrate(catalog)
        begin_rebuild(catalog, open_store(settings, exclusive=alone))
        store = open_installation_store(catalog, settings, exclusive=alone)
        taken = recover_catalog(
            catalog, store, settings, unnamed_age_seconds=0.0, progress=progress
        )
    if as_json:
        print_json(asdict(taken))
        return
    print_taken_in(taken)
    err_console.print(NEVER_IN_THE_JOURNAL, soft_wrap=True)


def print_taken_in(taken: RecoveryReport) -> None:
    """What came back, and what did not."""
    console.print(
        f"{taken.photos + taken.unnamed_photos} photos of {taken.maps} new maps came in, with "
        f"{taken.descriptors} descriptors in {taken.chunks} chunks, {taken.generations} "
        f"generations and {taken.vocabularies} vocabularies; {taken.queued_photos} photos are "
        "queued to be described",
        soft_wrap=True,
    )
    if taken.changed_photos or taken.deleted_photos:
        console.print(
            f"{taken.changed_photos} photos were changed and {taken.deleted_photos} deleted, as "
            "the journal says"
        )
    for old, new in taken.renamed_maps.items():
        err_console.print(
            f"Another map has the name {escape(old)}: the one of the journal is {new}."
        )
    if taken.unnamed_photos:
        err_console.print(
            f"The journal does not name {taken.unnamed_photos} photos: they are in the map "
            "default, with coordinates, heading and time as EXIF has them. Lost are their file "
            "names, place labels, tags, metadata, roles and maps, and what was said instead of "
            "EXIF.",
            soft_wrap=True,
        )
    if taken.unnamed_descriptors:
        err_console.print(
            f"{taken.unnamed_descriptors} descriptors belong to generations that the journal does "
            "not name: they can't be assigned to photos.",
            soft_wrap=True,
        )
    if taken.lost_originals:
        err_console.print(
            f"{taken.lost_originals} photos of the journal have no original in the store and stay "
            "out: they were deleted a moment before the catalog was lost, or their files are gone.",
            soft_wrap=True,
        )
    if taken.doubled_photos:
        err_console.print(f"{taken.doubled_photos} photos are there already, under another id.")
    for what, keys in (
        ("journal segments can't be read; restore them from a backup", taken.damaged_segments),
        ("chunks are damaged; their photos are described again", taken.damaged_chunks),
        ("originals can't be read as photos and stay out", taken.unreadable_originals),
    ):
        if keys:
            named = ", ".join(keys[:SHOWN]) + (" ..." if len(keys) > SHOWN else "")
            err_console.print(f"{len(keys)} {what}: {escape(named)}", soft_wrap=True)
