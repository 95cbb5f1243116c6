"""A folder as a library whose proposals go into XMP sidecars, and the points of GPX tracks."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import ClassVar
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
from services.cli.locate.library import LibraryPhoto, LocatedPhoto, UndoReport, WriteReport
from services.cli.locate.sidecars import (
    add_position,
    has_estimate,
    remove_position,
    replace_sidecar,
    sidecar_path,
)
from services.cli.output import printable_path, refuse_unwritable, utf8_path
from shared.config.command_line import command_line
from shared.errors import InvalidRequest, NotFound, PlacewiseError
from shared.geotagging.evidence import KnownPosition, add_time_zones
from shared.geotagging.fusion import Proposal
from shared.imaging.capture_place import is_null_island
from shared.imaging.photo_header import PhotoHeader


@dataclass(frozen=True, slots=True)
class FolderLibrary:
    """The photos below a folder; implements `PhotoLibrary`."""

    folder: Path
    time_zone: str | None = None
    clock_offset_seconds: float = 0.0
    written_are: ClassVar[str] = "files"

    @property
    def identity(self) -> str:
        """The absolute path."""
        return str(self.folder.resolve())

    @property
    def undo_command(self) -> str:
        """That of `placewise locate`."""
        return command_line("locate", self.folder, "--undo")

    def list_photos(self) -> Sequence[LibraryPhoto]:
        """Raises InvalidRequest: `no_photos`, `bad_time_zone`."""
        return read_folder(self.folder, self.time_zone, self.clock_offset_seconds)

    def fetch(self, photo: LibraryPhoto) -> Path:
        """Return the file."""
        return self.folder / photo.id

    def write(self, located: Sequence[LocatedPhoto]) -> WriteReport:
        """Write the sidecars; one that can't be written is skipped."""
        report = WriteReport()
        for location in located:
            name, photo = location.photo.name, self.folder / location.photo.id
            if location.proposal is None:
                report.skipped[name] = "has a place only, which --json prints"
                continue
            if reason := self._change_meanwhile(photo):
                report.skipped[name] = reason
                continue
            try:
                path = self._write_sidecar(photo, location.proposal)
            except PlacewiseError as error:
                report.skipped[name] = error.detail
            else:
                report.written.append(utf8_path(path.relative_to(self.folder)))
        return report

    def undo(self) -> UndoReport:
        """Take back what `write` has added to the sidecars, byte by byte.

        Raises:
            NotFound: `nothing_to_undo`.
            Misconfigured: `out_unwritable`.
            Unprocessable: As `replace_sidecar` raises it.
        """
        report = UndoReport()
        with refuse_unwritable(self.folder):
            for path in sorted(self.folder.rglob("*")):
                if path.suffix.lower() != ".xmp" or not path.is_file():
                    continue
                present = path.read_bytes()
                if not has_estimate(present):
                    continue
                name, former = utf8_path(path.relative_to(self.folder)), remove_position(present)
                if former is None:
                    path.unlink()
                    report.removed.append(name)
                elif former == present:
                    report.changed_since.append(name)
                else:
                    replace_sidecar(self.folder, path, former, present)
                    report.restored.append(name)
        if report == UndoReport():
            raise NotFound(
                "nothing_to_undo",
                f"No sidecar below {printable_path(self.folder)} has estimated coordinates.",
            )
        return report

    def _change_meanwhile(self, photo: Path) -> str | None:
        """Return why a photo needs no position any more; the searches may have taken minutes."""
        if not photo.exists():
            return "was moved or deleted meanwhile"
        if not read_photo(self.folder, photo).is_unlocated:
            return "got coordinates meanwhile"
        return None

    def _write_sidecar(self, photo: Path, proposal: Proposal) -> Path:
        """Add the position to the sidecar of a photo, or to a new one; return its path."""
        xmp = (path for path in find_sidecars(photo) if path.suffix.lower() == ".xmp")
        path = next(xmp, sidecar_path(photo))
        with refuse_unwritable(path):
            existing = path.read_bytes() if path.is_file() else None
            at = proposal.latitude, proposal.longitude
            content = add_position(existing, *at, proposal.radius_68_m, proposal.heading)
            replace_sidecar(self.folder, path, content, existing)
        return path


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
