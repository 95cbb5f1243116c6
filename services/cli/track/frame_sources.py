"""Frames of a track from a folder of photos or a video, each with its time."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from PIL import Image

from services.cli.locate.folder import read_folder
from services.cli.output import print_note, printable_path
from shared.errors import InvalidRequest, Misconfigured
from shared.imaging.file_formats import PHOTO_SUFFIXES

UNKNOWN_BEGIN = datetime.fromtimestamp(0, UTC)  # the time of a file is that of its last copy
MIN_STEP = timedelta(milliseconds=1)  # between photos whose clocks show the same time
ROUNDING_SECONDS = 1e-6
JPEG_QUALITY = 92  # of the frames of a video


@dataclass(frozen=True, slots=True)
class SourceFrame:
    """A photo to send, and what is known about it."""

    path: Path
    name: str
    captured_at: datetime
    """UTC"""
    latitude: float | None = None
    longitude: float | None = None


@dataclass(frozen=True, slots=True)
class FrameTiming:
    """How frames get their times."""

    every_seconds: float
    """between two frames of a video, and between photos in the order of their names"""
    begin: datetime | None
    """time of the first frame; None: of a video when it was recorded, else UNKNOWN_BEGIN"""


def read_photo_frames(folder: Path, timing: FrameTiming) -> list[SourceFrame]:
    """List the photos below a folder by their times, or by their names if one has no time.

    Raises:
        InvalidRequest: `no_photos`.
    """
    photos = read_folder(folder, None, 0.0)
    by_name = any(photo.time is None for photo in photos)
    first = timing.begin or UNKNOWN_BEGIN
    if by_name:
        _print_clock(timing.begin, None, "photos in the order of their names")
    frames = [
        SourceFrame(
            folder / photo.id,
            photo.name,
            first + timedelta(seconds=number * timing.every_seconds)
            if by_name or photo.time is None
            else photo.time,
            photo.latitude,
            photo.longitude,
        )
        for number, photo in enumerate(photos)
    ]
    return _with_distinct_times(sorted(frames, key=lambda frame: frame.captured_at))


def read_video_frames(video: Path, timing: FrameTiming, folder: Path) -> Iterator[SourceFrame]:
    """Decode a frame of a video every `timing.every_seconds` and write it to a folder as JPEG.

    Frames are turned as players turn them. A file is deleted when the next frame is requested.

    Raises:
        Misconfigured: `no_video_decoder`.
        InvalidRequest: `unreadable_video`.
    """
    try:
        import av  # optional: its wheels include FFmpeg
    except ImportError as error:
        raise Misconfigured(
            "no_video_decoder",
            f"Reading the video {printable_path(video)} needs PyAV. Install the extra "
            "`tracks` (uv pip install '.[tracks]' in the repository), or extract photos from the "
            "video and pass their folder.",
        ) from error
    try:
        with av.open(str(video)) as container:
            if video.suffix.lower() in PHOTO_SUFFIXES or not container.streams.video:
                raise InvalidRequest(
                    "unreadable_video",
                    f"{printable_path(video)} is neither a folder of photos nor a video. "
                    "Where a single photo was taken: placewise query PHOTO.",
                )
            recorded = _parse_created(container.metadata.get("creation_time"))
            first = timing.begin or recorded or UNKNOWN_BEGIN
            _print_clock(timing.begin, recorded, "the video")
            begin = None
            due = 0.0
            for frame in container.decode(video=0):
                if frame.time is None:
                    raise InvalidRequest(
                        "unreadable_video",
                        f"{printable_path(video)} does not say when its frames were taken. "
                        f"Give it times: ffmpeg -framerate 30 -i {video.name} -c copy ride.mp4",
                    )
                begin = frame.time if begin is None else begin
                seconds = frame.time - begin
                if seconds < due - ROUNDING_SECONDS:
                    continue
                steps = 1 + (seconds - due + ROUNDING_SECONDS) // timing.every_seconds
                due += timing.every_seconds * steps
                path = folder / f"frame-{seconds:010.3f}.jpg"
                image = Image.fromarray(frame.to_ndarray(format="rgb24"))
                image.rotate(frame.rotation, expand=True).save(path, quality=JPEG_QUALITY)
                yield SourceFrame(path, path.name, first + timedelta(seconds=seconds))
                path.unlink()
    except av.FFmpegError as error:
        raise InvalidRequest(
            "unreadable_video", f"Can't read the video {printable_path(video)}: {error}"
        ) from error


def _with_distinct_times(frames: list[SourceFrame]) -> list[SourceFrame]:
    """Delay frames that have the time of the one before: times are unique in a track."""
    distinct: list[SourceFrame] = []
    for frame in frames:
        earliest = distinct[-1].captured_at + MIN_STEP if distinct else frame.captured_at
        distinct.append(replace(frame, captured_at=max(frame.captured_at, earliest)))
    return distinct


def _print_clock(begin: datetime | None, recorded: datetime | None, source: str) -> None:
    """Say which clock the times of frames are of that have none in their EXIF."""
    if begin is not None:
        clock = f"{begin:%Y-%m-%d %H:%M:%S} UTC (--begin)"
    elif recorded is not None:
        clock = f"{recorded.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC, when it was recorded"
    else:
        clock = f"{UNKNOWN_BEGIN:%Y-%m-%d %H:%M:%S} UTC: their time is unknown (--begin sets it)"
    print_note(f"Times of {source} count from {clock}.")


def _parse_created(text: str | None) -> datetime | None:
    with contextlib.suppress(ValueError):
        created = datetime.fromisoformat(text or "")
        return created if created.tzinfo else created.replace(tzinfo=UTC)
    return None
