"""The photos of a folder, with times, cameras and coordinates, and the points of GPX tracks."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import astuple, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from xml.etree import ElementTree

from services.cli.ingest.geotags import list_photos
from services.cli.ingest.local_headers import (
    dated_photo,
    find_sidecars,
    in_time_zone,
    move_time,
    parse_time_zone,
    read_local_header,
    read_sidecar,
)
from services.cli.locate.library import LibraryPhoto
from services.cli.output import printable_path, utf8_path
from shared.errors import InvalidRequest
from shared.geotagging.evidence import KnownPosition, add_time_zones
from shared.imaging.capture_place import is_null_island
from shared.imaging.photo_header import PhotoHeader


def read_folder(
    folder: Path, time_zone: str | None, clock_offset_seconds: float
) -> list[LibraryPhoto]:
    """Read the photos below a folder, sorted by path. Their id is the path in the folder.

    Raises:
        InvalidRequest: `no_photos`, `bad_time_zone`.
    """
    photos = [read_photo(folder, path) for path in list_photos(folder)]
    return set_clocks(photos, time_zone, clock_offset_seconds)


def set_clocks(
    photos: Sequence[LibraryPhoto], time_zone: str | None, clock_offset_seconds: float
) -> list[LibraryPhoto]:
    """Complete the time zones of the cameras' clocks, and correct a wrong clock.

    Args:
        time_zone: Zone of times without one, such as `+02:00` or `Europe/Paris`.
        clock_offset_seconds: How far the clock was ahead of every camera that took a photo
            without coordinates.

    Raises:
        InvalidRequest: `bad_time_zone`.
    """
    zone = parse_time_zone(time_zone) if time_zone else None
    zoned = [
        photo if zone is None else in_time_zone(photo, zone) for photo in add_time_zones(photos)
    ]
    ahead = timedelta(seconds=clock_offset_seconds)
    unlocated = {photo.camera for photo in zoned if photo.is_unlocated}
    return [
        replace(photo, time=move_time(photo.time, lambda time: time - ahead))
        if photo.camera in unlocated
        else photo
        for photo in zoned
    ]


def check_time_zones(photos: Sequence[LibraryPhoto], why: str) -> None:
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
            if not is_null_island(latitude, longitude):
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


def read_photo(folder: Path, path: Path) -> LibraryPhoto:
    """Read the header of a photo and its sidecars."""
    size, modified_ns = _file_state(path)  # before its content
    sidecars = [read_sidecar(sidecar) for sidecar in find_sidecars(path)]
    header = PhotoHeader(0, 0)
    # The search names what is wrong with a photo that can't be read.
    with contextlib.suppress(OSError), path.open("rb") as file:
        header = read_local_header(file, sidecars)
    dated = dated_photo(utf8_path(path.relative_to(folder)), header)
    return LibraryPhoto(
        *astuple(dated),
        id=str(path.relative_to(folder)),
        state=f"{size} {modified_ns}",
        gps_error=header.gps_error,
    )


def _file_state(path: Path) -> tuple[int, int]:
    """Return size in bytes and modification time in ns; zeros for a file that is gone."""
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_size, status.st_mtime_ns
