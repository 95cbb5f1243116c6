"""`placewise storage backup`, `restore` and `rebuild`.

A backup is a folder with the catalog's rows and the objects that they refer to. `rebuild`
recovers a lost catalog from the object store alone. `maintenance` does the work; it is imported
when a command runs.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from services.cli.environment import read_settings
from services.cli.output import (
    JsonOption,
    err_console,
    print_json,
    print_message,
    print_note,
    print_result,
    progress_bar,
    stage_bars,
)

if TYPE_CHECKING:
    from shared.backup.folder import BackupProgress
    from shared.rebuild.recover import RecoveryReport

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
    with progress_reporter() as progress:
        from services.cli.operations.maintenance import back_up

        manifest = back_up(read_settings(), out, progress)
    if as_json:
        print_json(asdict(manifest))
    else:
        print_message(
            f"Backed up {sum(manifest.rows.values())} rows and {manifest.objects} objects "
            f"({manifest.object_bytes / 1e6:.1f} MB) to {out!s} as of "
            f"{manifest.made_at}"
        )
        for state, keys in (("missing", manifest.missing), ("damaged", manifest.damaged)):
            for key in keys[:MAX_KEYS_SHOWN]:
                err_console.print(f"[red]{state}[/red] {escape(key)}", soft_wrap=True)
            if len(keys) > MAX_KEYS_SHOWN:
                print_note(f"{len(keys)} objects are {state}. backup.json lists all of them.")
    if manifest.missing or manifest.damaged:
        print_note("Run `placewise verify` for details and remedies.")
        raise typer.Exit(1)


def restore(
    source: Annotated[Path, typer.Argument(metavar="FROM", help="Folder of a backup.")],
    as_json: JsonOption = False,
) -> None:
    """Restore a backup into an empty installation. Stop its services first.

    An interrupted restore resumes when the command is run again.
    """
    with progress_reporter() as progress:
        from services.cli.operations import maintenance

        manifest, restored = maintenance.restore(read_settings(), source, progress)
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
        yield stage_bars(bars)


NOT_RECOVERED_NOTE = (
    "API keys, webhooks, jobs, the search history and evaluation reports are not stored in the "
    "object store. Create keys and webhooks again."
)


def rebuild_catalog(as_json: JsonOption = False) -> None:
    """Rebuild a lost catalog from the object store. Stop all services first.

    Recovers photos with their metadata, maps, generations and vocabularies. An interrupted rebuild
    resumes when the command is run again.
    """
    with progress_reporter() as progress:
        from services.cli.operations.maintenance import rebuild

        taken = rebuild(read_settings(), progress)
    if as_json:
        print_json(asdict(taken))
        return
    print_taken_in(taken)
    print_note(NOT_RECOVERED_NOTE)


def print_taken_in(taken: RecoveryReport) -> None:
    """Print what was recovered into the catalog and what was not."""
    print_message(
        f"Recovered {taken.photos + taken.unnamed_photos} photos in {taken.maps} new maps, with "
        f"{taken.descriptors} descriptors in {taken.chunks} chunks, {taken.generations} "
        f"generations and {taken.vocabularies} vocabularies. {taken.queued_photos} photos are "
        "queued for description."
    )
    if taken.changed_photos or taken.deleted_photos:
        print_message(
            f"The journal's changes were applied: {taken.changed_photos} photos updated, "
            f"{taken.deleted_photos} deleted."
        )
    for old, new in taken.renamed_maps.items():
        print_note(f"Another map is named {old}. The journal's map was renamed to {new}.")
    if taken.unnamed_photos:
        print_note(
            f"{taken.unnamed_photos} photos are not in the journal. They were added to the map "
            "default with coordinates, heading and time from EXIF. Their file names, place labels, "
            "tags, metadata, roles and maps, and values that overrode EXIF, are lost."
        )
    if taken.unnamed_descriptors:
        print_note(
            f"{taken.unnamed_descriptors} descriptors belong to generations that are not in the "
            "journal and can't be assigned to photos."
        )
    if taken.lost_originals:
        print_note(
            f"{taken.lost_originals} photos of the journal have no original in the store and were "
            "not recovered: they were deleted just before the catalog was lost, or their files are "
            "missing."
        )
    if taken.doubled_photos:
        print_note(f"{taken.doubled_photos} photos are already stored under another ID.")
    for problem, keys in (
        ("journal segments can't be read. Restore them from a backup", taken.damaged_segments),
        ("chunks are damaged. Their photos will be described again", taken.damaged_chunks),
        ("originals can't be decoded and were not recovered", taken.unreadable_originals),
    ):
        if keys:
            listed = ", ".join(keys[:MAX_KEYS_SHOWN])
            listed += " ..." if len(keys) > MAX_KEYS_SHOWN else ""
            print_note(f"{len(keys)} {problem}: {listed}")
