"""`placewise track`: follow a folder of photos or a video through a map."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Iterable, Sized
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated
from uuid import UUID

import typer
from rich.markup import escape
from rich.progress import Progress
from rich.table import Column

from placewise.answers import OneTrack, TrackFrame
from placewise.client import Client
from services.cli.client import MapOptions
from services.cli.output import (
    Table,
    atomic_write,
    check_output_path,
    format_percent,
    print_json,
    print_note,
    print_problem,
    print_table,
    printable_path,
    progress_bar,
)
from services.cli.track.frame_sources import (
    FrameTiming,
    SourceFrame,
    read_photo_frames,
    read_video_frames,
)
from services.cli.track.gpx import to_gpx
from shared.errors import Conflict, InvalidRequest, TooLarge, Unprocessable, UnsupportedMedia
from shared.tracks.motion import MOTION_MODELS

FRAMES_AHEAD = 8  # stored before the first of them must be applied: they are described as a batch
WAIT_SECONDS = 20.0


def track(
    common: MapOptions,
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", exists=True, help="A folder of photos, or a video.")
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.gpx", help="Write the track as GPX.")
    ] = None,
    motion: Annotated[
        str | None,
        typer.Option(help=f"How the camera moves: {', '.join(MOTION_MODELS)}. Default: car."),
    ] = None,
    max_speed: Annotated[
        float | None, typer.Option(min=0.001, help="Maximum speed in m/s, instead of --motion.")
    ] = None,
    every: Annotated[
        float,
        typer.Option(
            min=0.001,
            help="Seconds between two frames of a video, and between photos without a time.",
        ),
    ] = 1.0,
    begin: Annotated[
        datetime | None,
        typer.Option(
            help="Time of the first frame, UTC, for videos and photos in the order of their names. "
            "Default: when the video was recorded, otherwise 1970-01-01."
        ),
    ] = None,
    gps_accuracy: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Use the positions in the EXIF, with this accuracy (68 %). Without it they "
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
) -> None:
    """Follow the camera that took the photos or the video in SOURCE through a map, frame by frame.

    Photos are in the order of their EXIF times if all have one, otherwise of their names. They are
    not added to the map. The track stays on the server for some time, where the page
    shows it.
    """
    if out is not None:
        check_output_path(out, ".gpx", "a track")
    timing = FrameTiming(every, begin and begin.replace(tzinfo=UTC))
    with (
        common.connect() as client,
        progress_bar() as progress,
        tempfile.TemporaryDirectory() as folder,
    ):
        frames = (
            read_photo_frames(source, timing)
            if source.is_dir()
            else read_video_frames(source, timing, Path(folder))
        )
        begun = client.begin_track(motion=motion, max_speed_mps=max_speed)
        _send_frames(client, begun.track_id, frames, gps_accuracy, progress)
        try:
            result = client.track(begun.track_id, smoothed=smoothed)
        except Conflict as error:
            if error.code != "track_too_long":
                raise
            print_note(error.detail)
            result = client.track(begun.track_id)
    if out is not None:
        with atomic_write(out) as file:
            file.write(to_gpx(result))
    if common.as_json:
        print_json(result)
    else:
        _print_track(result, out)


def _send_frames(
    client: Client,
    track_id: UUID,
    frames: Iterable[SourceFrame],
    gps_accuracy_m: float | None,
    progress: Progress,
) -> None:
    """Send frames, up to FRAMES_AHEAD before the first of them is applied, and wait for all."""
    total = len(frames) if isinstance(frames, Sized) else None
    bar = progress.add_task("frames", total=total)
    ahead: deque[TrackFrame] = deque()
    version = 0
    for frame in frames:
        has_fix = gps_accuracy_m is not None and frame.latitude is not None
        try:
            sent = client.add_frame(
                track_id,
                frame.path,
                frame.captured_at,
                wait=False,
                expected_version=version,
                latitude=frame.latitude if has_fix else None,
                longitude=frame.longitude if has_fix else None,
                accuracy_m=gps_accuracy_m if has_fix else None,
            )
        except (Unprocessable, UnsupportedMedia, TooLarge) as error:
            if error.code == "invalid_field":
                raise
            print_problem(error.code, frame.name, error.detail)
            progress.advance(bar)
            continue
        version = sent.version
        ahead.append(sent)
        if len(ahead) > FRAMES_AHEAD:
            _wait_for_frame(client, track_id, ahead.popleft())
            progress.advance(bar)
    for sent in ahead:
        _wait_for_frame(client, track_id, sent)
        progress.advance(bar)
    if not version:
        raise InvalidRequest("no_frames", "No frame could be sent.")


def _wait_for_frame(client: Client, track_id: UUID, frame: TrackFrame) -> None:
    while frame.status == "pending":
        frame = client.track_frame(track_id, frame.frame_id, wait_seconds=WAIT_SECONDS)
    if frame.error is not None:
        print_problem(frame.error["code"], frame.filename, frame.error["detail"])


def _print_track(track: OneTrack, out: Path | None) -> None:
    states = [frame.state for frame in track.frames if frame.state is not None]
    has_places = any(state.latitude is not None or state.place for state in states)
    table = Table(
        "time",
        "photo",
        "status",
        Column("probability", justify="right"),
        Column("latitude", no_wrap=True),
        Column("longitude", no_wrap=True),
        "place" if has_places else "image_id",
    )
    for frame in track.frames:
        state = frame.state
        at = state if state is not None and state.latitude is not None else None
        table.add_row(
            f"{frame.captured_at:%H:%M:%S}",
            escape(frame.filename),
            state.status if state else frame.status,
            format_percent(state.probability if state else None),
            f"{at.latitude:.6f}" if at else "",
            f"{at.longitude:.6f}" if at else "",
            escape(str((state and (state.place if has_places else state.image_id)) or "")),
        )
    print_table(table)
    if states and not any(state.probability for state in states):
        print_note("The map has no coordinates, place labels or times that tell where.")
    tracked = sum(state.status == "tracking" for state in states)
    print_note(
        f"{tracked} of {len(track.frames)} frames are tracked. Track {track.track_id}"
        + (f", {printable_path(out)}" if out else "")
    )
