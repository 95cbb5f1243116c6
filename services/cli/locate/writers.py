"""A folder as a library, and what is written: XMP sidecars, EXIF, a CSV table or GPX waypoints.

EXIF is written by the program exiftool.
"""

from __future__ import annotations

import csv
import errno
import io
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

from services.cli.ingest.local_headers import find_sidecars
from services.cli.locate.folder import read_folder, read_photo
from services.cli.locate.library import LibraryPhoto, LocatedPhoto, UndoReport, WriteReport
from services.cli.locate.sidecars import METHOD, TRUE_NORTH, add_position, sidecar_path
from services.cli.locate.undo_journal import UndoJournal, open_journal, undo
from services.cli.output import utf8_path
from shared.errors import Misconfigured, PlacewiseError, Unprocessable
from shared.geotagging.fusion import Proposal
from shared.imaging.photo_header import PhotoHeader, read_photo_header
from shared.ingest.photo_metadata import escape_csv_text

GPX_NAMESPACE = "http://www.topografix.com/GPX/1/1"
ERRORS_OF_ONE_FILE = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG)
CSV_NAME, GPX_NAME = "placewise-locations.csv", "placewise-locations.gpx"


class Target(StrEnum):
    SIDECAR = "sidecar"
    EXIF = "exif"
    CSV = "csv"
    GPX = "gpx"


@dataclass(frozen=True, slots=True)
class FolderLibrary:
    """The photos below a folder; implements `PhotoLibrary`."""

    folder: Path
    target: Target
    time_zone: str | None = None
    clock_offset_seconds: float = 0.0

    @property
    def identity(self) -> str:
        """The absolute path."""
        return str(self.folder.resolve())

    def list_photos(self) -> Sequence[LibraryPhoto]:
        """Raises InvalidRequest: `no_photos`, `bad_time_zone`."""
        return read_folder(self.folder, self.time_zone, self.clock_offset_seconds)

    def fetch(self, photo: LibraryPhoto) -> Path:
        """Return the file."""
        return self.folder / photo.id

    def write(self, located: Sequence[LocatedPhoto]) -> WriteReport:
        """Write into the target; see `write_locations`."""
        return write_locations(self.folder, self.target, located)

    def undo(self) -> UndoReport:
        """Restore the files; see `undo_journal.undo`."""
        return undo(self.folder)


def write_locations(folder: Path, target: Target, locations: Sequence[LocatedPhoto]) -> WriteReport:
    """Write proposals, with a journal that undoes it.

    Args:
        locations: The proposals. Those without coordinates can only be written to a CSV table.

    Raises:
        Misconfigured: `no_exif_writer`, `out_unwritable`.
        Conflict: `locate_in_progress`.
    """
    report = WriteReport()
    positions = [(each, each.proposal) for each in locations if each.proposal is not None]
    if target != Target.CSV:
        missing = [each.photo.name for each in locations if each.proposal is None]
        report.skipped.update(dict.fromkeys(missing, "has a place only, which --write csv writes"))
    write_one = _photo_writer(target)
    with open_journal(folder) as journal:
        if write_one is None:
            name, content = (
                (CSV_NAME, _to_csv(locations))
                if target == Target.CSV
                else (GPX_NAME, _to_gpx(positions))
            )
            journal.install(folder / name, journal.stage(folder / name, content))
            report.written.append(name)
        else:
            for location, proposal in positions:
                name, photo = location.photo.name, folder / location.photo.id
                if reason := _change_meanwhile(folder, photo):
                    report.skipped[name] = reason
                    continue
                try:
                    path = write_one(journal, photo, proposal)
                except PlacewiseError as error:
                    report.skipped[name] = error.detail
                except OSError as error:
                    if error.errno not in ERRORS_OF_ONE_FILE:
                        raise
                    report.skipped[name] = f"can't be written: {error.strerror}"
                else:
                    report.written.append(utf8_path(path.relative_to(folder)))
    return report


def _change_meanwhile(folder: Path, photo: Path) -> str | None:
    """Return why a photo needs no position any more; the searches may have taken minutes."""
    if not photo.exists():
        return "was moved or deleted meanwhile"
    if not read_photo(folder, photo).is_unlocated:
        return "got coordinates meanwhile"
    return None


def _photo_writer(target: Target) -> Callable[[UndoJournal, Path, Proposal], Path] | None:
    """Return what writes the position of one photo and returns the path of the written file."""
    if target == Target.SIDECAR:
        return _write_sidecar
    if target != Target.EXIF:
        return None
    exif_writer = find_exif_writer()

    def write(journal: UndoJournal, photo: Path, proposal: Proposal) -> Path:
        staged = journal.stage(photo)
        write_exif(exif_writer, staged, proposal)
        journal.install(photo, staged)
        return photo

    return write


def _write_sidecar(journal: UndoJournal, photo: Path, proposal: Proposal) -> Path:
    there = next(iter(find_sidecars(photo)), None)
    path = there or sidecar_path(photo)
    content = add_position(
        there.read_bytes() if there else None,
        proposal.latitude,
        proposal.longitude,
        proposal.radius_68_m,
        proposal.heading,
    )
    journal.install(path, journal.stage(path, content))
    return path


def _to_csv(locations: Sequence[LocatedPhoto]) -> bytes:
    """Return a table that `placewise index --csv` reads."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("filename", "latitude", "longitude", "heading", "place"))
    for each in locations:
        found = each.proposal
        position = (found.latitude, found.longitude, found.heading) if found else ("", "", "")
        texts = escape_csv_text(each.photo.name), escape_csv_text(each.place or "")
        writer.writerow((texts[0], *position, texts[1]))
    return text.getvalue().encode()


def _to_gpx(positions: Sequence[tuple[LocatedPhoto, Proposal]]) -> bytes:
    root = ElementTree.Element(
        "gpx", {"xmlns": GPX_NAMESPACE, "version": "1.1", "creator": "Placewise"}
    )
    for location, proposal in positions:
        degrees = {"lat": f"{proposal.latitude:.7f}", "lon": f"{proposal.longitude:.7f}"}
        point = ElementTree.SubElement(root, "wpt", degrees)
        if location.photo.time is not None and location.photo.time_zone_is_known:
            time = location.photo.time.isoformat().replace("+00:00", "Z")
            ElementTree.SubElement(point, "time").text = time
        ElementTree.SubElement(point, "name").text = location.photo.name
        ElementTree.SubElement(point, "desc").text = (
            f"{100 * proposal.probability:.1f} % within {proposal.radius_m:.0f} m: "
            f"{proposal.reason}"
        )
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))


TOLERANCE_DEGREES = 1e-6
ExifWriter = Callable[[Path, Proposal], None]


def find_exif_writer() -> ExifWriter:
    """Return the writer of EXIF, which is the program exiftool.

    Raises:
        Misconfigured: `no_exif_writer`.
    """
    program = shutil.which("exiftool")
    if program is None:
        raise Misconfigured(
            "no_exif_writer",
            "Writing EXIF needs exiftool (Debian, Ubuntu: apt install libimage-exiftool-perl; "
            "macOS: brew install exiftool). --write sidecar does not.",
        )
    return partial(_write_with_exiftool, program)


def write_exif(writer: ExifWriter, photo: Path, proposal: Proposal) -> None:
    """Write coordinates, and a heading unless it has one, into a photo and read them back.

    Raises:
        Unprocessable: `exif_not_written`.
    """
    if _read_header(photo).has_heading:
        proposal = replace(proposal, heading=None)
    writer(photo, proposal)
    header = _read_header(photo)
    for written, read in (
        (proposal.latitude, header.latitude),
        (proposal.longitude, header.longitude),
    ):
        if read is None or abs(written - read) > TOLERANCE_DEGREES:
            raise Unprocessable(
                "exif_not_written", "The coordinates can't be read back from the EXIF."
            )


def _read_header(photo: Path) -> PhotoHeader:
    try:
        with photo.open("rb") as file:
            return read_photo_header(file, sys.maxsize)
    except PlacewiseError as error:
        raise Unprocessable("exif_not_written", error.detail) from error


def _write_with_exiftool(program: str, photo: Path, proposal: Proposal) -> None:
    arguments = [
        f"-GPSLatitude={abs(proposal.latitude):.7f}",
        f"-GPSLatitudeRef={'NS'[proposal.latitude < 0]}",
        f"-GPSLongitude={abs(proposal.longitude):.7f}",
        f"-GPSLongitudeRef={'EW'[proposal.longitude < 0]}",
        "-GPSMapDatum=WGS-84",
        f"-GPSHPositioningError={proposal.radius_68_m:.2f}",
        f"-GPSProcessingMethod={METHOD}",
    ]
    if proposal.heading is not None:
        arguments += [
            f"-GPSImgDirection={proposal.heading:.2f}",
            f"-GPSImgDirectionRef={TRUE_NORTH}",
        ]
    run = subprocess.run(  # noqa: S603 the program is exiftool
        [program, "-q", "-overwrite_original", *arguments, str(photo.absolute())],
        capture_output=True,
        text=True,
    )
    if run.returncode:
        reason = " ".join(run.stderr.split())
        raise Unprocessable("exif_not_written", f"exiftool can't write the EXIF: {reason}")
