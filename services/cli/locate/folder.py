"""The photos of a folder, with times, cameras and coordinates, and the points of GPX tracks."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from pathlib import Path
from xml.etree import ElementTree
from zoneinfo import ZoneInfo

from services.cli.ingest.geotags import list_photos
from services.cli.locate.sidecars import embedded_xmp, find_sidecar, read_position
from services.cli.output import printable_path, utf8_path
from shared.errors import InvalidRequest, PlacewiseError
from shared.geotagging.evidence import DatedPhoto, KnownPosition
from shared.imaging.photo_header import PhotoHeader, read_photo_header


@dataclass(frozen=True, slots=True)
class FolderPhoto(DatedPhoto):
    """A photo of the folder; its coordinates are of the EXIF, of XMP in it, or of its sidecar."""

    path: Path


def read_folder(
    folder: Path, time_zone: str | None, clock_offset_seconds: float
) -> list[FolderPhoto]:
    """Read the photos below a folder, sorted by path.

    Args:
        time_zone: Zone of times without one, such as `+02:00` or `Europe/Paris`.
        clock_offset_seconds: How far the clock was ahead of every camera that took a photo
            without coordinates.

    Raises:
        InvalidRequest: `no_photos`, `bad_time_zone`.
    """
    zone = _parse_time_zone(time_zone) if time_zone else None
    photos = [read_photo(folder, path, zone) for path in list_photos(folder)]
    ahead = timedelta(seconds=clock_offset_seconds)
    unlocated = {photo.camera for photo in photos if photo.latitude is None}
    return [
        replace(photo, time=_in_range(photo.time, lambda time: time - ahead))
        if photo.camera in unlocated
        else photo
        for photo in photos
    ]


def _in_range(time: datetime | None, change: Callable[[datetime], datetime]) -> datetime | None:
    """Change a time; None if it was no date, such as 0001-01-01, which can't be moved."""
    try:
        return None if time is None else change(time)
    except OverflowError:
        return None


def _parse_time_zone(text: str) -> tzinfo:
    """Parse an offset such as `+02:00`, `UTC` or a name of the time zone database."""
    with contextlib.suppress(ValueError):
        offset = datetime.fromisoformat(f"2000-01-01T00:00:00{text}").utcoffset()
        if offset is not None:
            return timezone(offset)
    try:
        return ZoneInfo(text)
    except (ValueError, LookupError, OSError) as error:
        raise InvalidRequest(
            "bad_time_zone",
            f"{text!r} is no time zone. Write an offset such as +02:00, or a name such as "
            "Europe/Paris.",
        ) from error


def check_time_zones(photos: Sequence[FolderPhoto], why: str) -> None:
    """Check that all times have a zone.

    Raises:
        InvalidRequest: `unknown_time_zone`.
    """
    unknown = [p.name for p in photos if p.time is not None and not p.time_zone_is_known]
    if unknown:
        raise InvalidRequest(
            "unknown_time_zone",
            f"{why} needs times in UTC, but the time zone of {len(unknown)} photos is not in their "
            f"EXIF, such as that of {unknown[0]}. Pass the zone that the camera's clock was set "
            "to: --time-zone +02:00 or --time-zone Europe/Paris.",
        )


def read_gpx(path: Path) -> list[KnownPosition]:
    """Read the track points of a GPX file that have a time, in the order of their times.

    Raises:
        InvalidRequest: `bad_gpx`.
    """
    points = []
    try:
        for element in ElementTree.parse(path).iter():  # noqa: S314 Expat bounds entities
            if element.tag.rpartition("}")[2] != "trkpt":
                continue
            text = next((e.text for e in element if e.tag.rpartition("}")[2] == "time"), None)
            if text is None:
                continue
            time = datetime.fromisoformat(text.strip())
            time = time.replace(tzinfo=time.tzinfo or UTC).astimezone(UTC)
            latitude, longitude = float(element.attrib["lat"]), float(element.attrib["lon"])
            if not (abs(latitude) <= 90 and abs(longitude) <= 180):
                raise ValueError(f"the position {latitude}, {longitude} does not exist")
            points.append(KnownPosition(time, latitude, longitude))
    except (OSError, ElementTree.ParseError, KeyError, ValueError, OverflowError) as error:
        raise InvalidRequest(
            "bad_gpx", f"Can't read the GPX track {printable_path(path)}: {error}"
        ) from error
    if not points:
        raise InvalidRequest(
            "bad_gpx", f"{printable_path(path)} has no track points with a time (trkpt, time)."
        )
    return sorted(points, key=lambda point: point.time)


def read_photo(folder: Path, path: Path, zone: tzinfo | None = None) -> FolderPhoto:
    """Read the header of a photo and its sidecar; `zone` is that of times without one."""
    header, xmp = PhotoHeader(0, 0), None
    # The search names what is wrong with a photo that can't be read.
    with contextlib.suppress(PlacewiseError, OSError), path.open("rb") as file:
        header = read_photo_header(file, sys.maxsize)
        file.seek(0)
        xmp = embedded_xmp(file)
    time = header.captured_at
    if zone is not None and not header.time_zone_is_known:
        time = _in_range(time, lambda clock: clock.replace(tzinfo=zone).astimezone(UTC))
    latitude, longitude = header.latitude, header.longitude
    sidecar = find_sidecar(path)
    for data in (xmp, sidecar.read_bytes() if sidecar else None):
        if latitude is None and data is not None:
            latitude, longitude = read_position(data) or (None, None)
    return FolderPhoto(
        utf8_path(path.relative_to(folder)),
        time,
        header.time_zone_is_known or (time is not None and zone is not None),
        header.camera,
        latitude,
        longitude,
        path,
    )
