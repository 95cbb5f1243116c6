"""`placewise locate`: propose where the photos of a folder were taken that have no coordinates."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.client import MapOptions
from services.cli.locate.folder import FolderLibrary
from services.cli.locate.proposals import LocateOptions, locate_library, report_undo


def locate(
    options: LocateOptions,
    common: MapOptions,
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            exists=True,
            file_okay=False,
            help="A folder of photos, searched recursively.",
        ),
    ],
    write: Annotated[
        bool,
        typer.Option(
            "--write",
            help="Write the accepted proposals into XMP sidecars. Without it, nothing is written.",
        ),
    ] = False,
    undo_changes: Annotated[
        bool, typer.Option("--undo", help="Restore all files that --write has changed in DIR.")
    ] = False,
) -> None:
    """Propose where the photos in DIR were taken that have no coordinates.

    A proposal combines the photos of the map that look similar, photos of the same camera that were
    taken shortly before and after and have coordinates, and a GPX track. Coordinates that a photo
    has are never changed.
    """
    library = FolderLibrary(folder, options.time_zone, options.clock_offset)
    if undo_changes:
        undone = library.undo()
        message = f"{len(undone.restored)} files restored, {len(undone.removed)} removed."
        report_undo(undone, message, common.as_json)
    elif not locate_library(library, options, common, common.connect, write=write):
        raise typer.Exit(1)
