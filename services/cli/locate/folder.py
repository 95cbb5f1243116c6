"""The photos of a folder, with times, cameras and coordinates, and the points of GPX tracks."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, replace
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
from services.cli.output import printable_path, utf8_path
from shared.errors import InvalidRequest
from shared.geotagging.evidence import DatedPhoto, KnownPosition, add_time_zones
from shared.imaging.capture_place import is_null_island
from shared.imaging.photo_header import PhotoHeader


@dataclass(frozen=True, slots=True)
class FolderPhoto(DatedPhoto):
    """A photo of the folder; its coordinates are of the EXIF, of XMP in it, or of its sidecar."""

    path: Path = field(kw_only=True)
    gps_error: str | None = field(kw_only=True)
    """why it may have coordinates although none are known"""

    @property
    def is_unlocated(self) -> bool:
        """Whether the photo certainly has no coordinates."""
        return self.latitude is None and self.gps_error is None


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
    zone = parse_time_zone(time_zone) if time_zone else None
    read = add_time_zones([read_photo(folder, path) for path in list_photos(folder)])
    photos = [photo if zone is None else in_time_zone(photo, zone) for photo in read]
    ahead = timedelta(seconds=clock_offset_seconds)
    unlocated = {photo.camera for photo in photos if photo.is_unlocated}
    return [
        replace(photo, time=move_time(photo.time, lambda time: time - ahead))
        if photo.camera in unlocated
        else photo
        for photo in photos
    ]


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


def read_photo(folder: Path, path: Path) -> FolderPhoto:
    """Read the header of a photo and its sidecars."""
    sidecars = [read_sidecar(sidecar) for sidecar in find_sidecars(path)]
    header = PhotoHeader(0, 0)
    # The search names what is wrong with a photo that can't be read.
    with contextlib.suppress(OSError), path.open("rb") as file:
        header = read_local_header(file, sidecars)
    dated = dated_photo(utf8_path(path.relative_to(folder)), header)
    return FolderPhoto(*astuple(dated), path=path, gps_error=header.gps_error)
