"""A folder as a library, and what is written: XMP sidecars or a CSV table."""

from __future__ import annotations

import csv
import errno
import io
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from services.cli.ingest.local_headers import find_sidecars
from services.cli.locate.folder import read_folder, read_photo
from services.cli.locate.library import LibraryPhoto, LocatedPhoto, UndoReport, WriteReport
from services.cli.locate.sidecars import add_position, sidecar_path
from services.cli.locate.undo_journal import UndoJournal, open_journal, undo
from services.cli.output import utf8_path
from shared.errors import PlacewiseError
from shared.geotagging.fusion import Proposal
from shared.ingest.photo_metadata import escape_csv_text

ERRORS_OF_ONE_FILE = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG)
CSV_NAME = "placewise-locations.csv"


class Target(StrEnum):
    SIDECAR = "sidecar"
    CSV = "csv"


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
        Misconfigured: `out_unwritable`.
        Conflict: `locate_in_progress`.
    """
    report = WriteReport()
    with open_journal(folder) as journal:
        if target == Target.CSV:
            table = folder / CSV_NAME
            journal.write(table, _to_csv(locations), _read(table))
            report.written.append(CSV_NAME)
            return report
        for location in locations:
            name, photo = location.photo.name, folder / location.photo.id
            proposal = location.proposal
            if proposal is None:
                report.skipped[name] = "has a place only, which --write csv writes"
                continue
            if reason := _change_meanwhile(folder, photo):
                report.skipped[name] = reason
                continue
            try:
                path = _write_sidecar(journal, photo, proposal)
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


def _write_sidecar(journal: UndoJournal, photo: Path, proposal: Proposal) -> Path:
    """Add the position to the sidecar of a photo, or to a new one; return its path."""
    path = next(iter(find_sidecars(photo)), sidecar_path(photo))
    existing = _read(path)
    content = add_position(
        existing,
        proposal.latitude,
        proposal.longitude,
        proposal.radius_68_m,
        proposal.heading,
    )
    journal.write(path, content, existing)
    return path


def _read(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None  # reading a FIFO would wait for ever


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
