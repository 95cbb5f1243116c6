"""`placewise track`: follow a folder of photos or a video through a map."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Iterable
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.progress import Progress
from rich.table import Column, Table

from placewise.answers import OneTrack, Photo, TrackFrame
from placewise.client import Client
from services.cli.client import connect
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    console,
    err_console,
    print_json,
    progress_bar,
    report_errors,
)
from services.cli.track.frame_sources import (
    FrameTiming,
    Order,
    SourceFrame,
    read_photo_frames,
    read_video_frames,
)
from services.cli.track.track_files import (
    PICTURE_SUFFIXES,
    WRITERS,
    check_track_files,
    write_track_file,
)
from shared.errors import InvalidRequest
from shared.tracks.motion import MOTION_MODELS

FRAMES_AHEAD = 8  # stored before the first of them must be applied: they are described as a batch
WAIT_SECONDS = 20.0
MAX_PHOTOS_DRAWN = 20_000


def track(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTOS_OR_VIDEO", exists=True, help="A folder of photos, or a video."
        ),
    ],
    out: Annotated[
        list[Path] | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help=f"Write the track; the format follows from the extension: {', '.join(WRITERS)}. "
            "May be repeated.",
        ),
    ] = None,
    motion: Annotated[
        str | None,
        typer.Option(help=f"How the camera moves: {', '.join(MOTION_MODELS)}. Default: car."),
    ] = None,
    max_speed: Annotated[
        float | None, typer.Option(min=0, help="Maximum speed in m/s, instead of --motion.")
    ] = None,
    every: Annotated[
        float,
        typer.Option(
            min=0.001,
            help="Seconds between two frames of a video, and between photos without a time.",
        ),
    ] = 1.0,
    order: Annotated[
        Order | None,
        typer.Option(
            help="Order of the photos. Default: by their EXIF times if all have one, otherwise by "
            "their names."
        ),
    ] = None,
    begin: Annotated[
        datetime | None,
        typer.Option(
            help="Time of the first frame, UTC, for videos and photos in the order of their names. "
            "Default: the time of the file."
        ),
    ] = None,
    gps_accuracy: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Use the positions in the photos' EXIF, with this accuracy (68 %). Without it they "
            "are ignored.",
        ),
    ] = None,
    smoothed: Annotated[
        bool,
        typer.Option(
            "--smoothed/--live",
            help="States given all frames, or as they were known at each frame.",
        ),
    ] = True,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Follow the camera that took PHOTOS_OR_VIDEO through a map, frame by frame.

    The photos are not added to the map. The track stays on the server for some time, where the page
    shows it.
    """
    files = out or []
    with report_errors(as_json):
        check_track_files(files)
        timing = FrameTiming(every, order, begin and begin.replace(tzinfo=UTC))
        with (
            connect(server, map_name, key) as client,
            progress_bar() as progress,
            tempfile.TemporaryDirectory() as folder,
        ):
            if source.is_dir():
                frames: Iterable[SourceFrame] = read_photo_frames(source, timing)
                total = len(list(frames))
            else:
                frames, total = read_video_frames(source, timing, Path(folder)), None
            begun = client.begin_track(motion=motion, max_speed_mps=max_speed)
            bar = progress.add_task("frames", total=total)
            _send_frames(client, begun.track_id, frames, gps_accuracy, progress, bar)
            result = client.track(begun.track_id, smoothed=smoothed)
            draws = any(file.suffix.lower() in PICTURE_SUFFIXES for file in files)
            photos = list(islice(client.photos(role="database"), MAX_PHOTOS_DRAWN)) if draws else []
        for file in files:
            write_track_file(file, result, photos)
        if as_json:
            print_json(result)
        else:
            _print_track(result, files)
