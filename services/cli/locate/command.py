"""`placewise locate`: propose where the photos of a folder were taken that have no coordinates."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from services.cli.client import connect
from services.cli.locate.folder import FolderLibrary
from services.cli.locate.proposals import LocateOptions, locate_library, report_undo
from services.cli.output import JsonOption, KeyOption, MapOption, ServerOption, TimeZoneOption
from shared.config.command_line import command_line
from shared.tracks.motion import MOTION_MODELS

GpxOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="GPX track of the trip.", exists=True, dir_okay=False),
]
AcceptOption = Annotated[
    float, typer.Option(min=0, max=1, help="Probability from which a proposal is accepted.")
]
RadiusOption = Annotated[
    float, typer.Option(min=10, max=2000, help="Radius in metres that the probability is for.")
]
MotionOption = Annotated[
    str,
    typer.Option(
        help=f"How the photographer moved: {', '.join(MOTION_MODELS)}, or a maximum speed in m/s."
    ),
]
TogetherOption = Annotated[
    bool,
    typer.Option(
        "--together",
        help="The people with the cameras travelled together: photos of all cameras count as "
        "neighbours in time, not only those of the same camera.",
    ),
]
ClockOffsetOption = Annotated[
    float,
    typer.Option(metavar="SECONDS", help="How far the clock of the cameras without GPS was ahead."),
]
PictureOption = Annotated[
    bool, typer.Option("--picture/--no-picture", help="Search the map with the photos.")
]


def locate(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            exists=True,
            file_okay=False,
            help="A folder of photos, searched recursively.",
        ),
    ],
    gpx: GpxOption = None,
    accept: AcceptOption = 0.95,
    radius: RadiusOption = 100.0,
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
    motion: MotionOption = "walk",
    together: TogetherOption = False,
    time_zone: TimeZoneOption = None,
    clock_offset: ClockOffsetOption = 0.0,
    picture: PictureOption = True,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Propose where the photos in DIR were taken that have no coordinates.

    A proposal combines the photos of the map that look similar, photos of the same camera that were
    taken shortly before and after and have coordinates, and a GPX track. Coordinates that a photo
    has are never changed.
    """
    library = FolderLibrary(folder, time_zone, clock_offset)
    if undo_changes:
        undone = library.undo()
        message = f"{len(undone.restored)} files restored, {len(undone.removed)} removed."
        report_undo(undone, message, as_json)
        return
    options = LocateOptions(
        accept, radius, motion, together, gpx, picture, server, map_name, write, as_json,
        command_line("locate", folder, "--undo"), "files",
    )  # fmt: skip
    if not locate_library(library, options, partial(connect, server, map_name, key)):
        raise typer.Exit(1)
