"""A folder as a library: accepted proposals are written into XMP sidecars."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from services.cli.ingest.local_headers import find_sidecars
from services.cli.locate.folder import read_folder, read_photo
from services.cli.locate.library import LibraryPhoto, LocatedPhoto, UndoReport, WriteReport
from services.cli.locate.sidecars import add_position, sidecar_path
from services.cli.locate.undo_journal import UndoJournal, open_journal, undo
from services.cli.output import utf8_path
from shared.errors import PlacewiseError
from shared.geotagging.fusion import Proposal

ERRORS_OF_ONE_FILE = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG)


@dataclass(frozen=True, slots=True)
class FolderLibrary:
    """The photos below a folder; implements `PhotoLibrary`."""

    folder: Path
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
        """Write the sidecars, with a journal that undoes it.

        Raises:
            Misconfigured: `out_unwritable`.
            Conflict: `locate_in_progress`.
        """
        report = WriteReport()
        with open_journal(self.folder) as journal:
            for location in located:
                name, photo = location.photo.name, self.folder / location.photo.id
                if location.proposal is None:
                    report.skipped[name] = "has a place only, which --json prints"
                    continue
                if reason := self._change_meanwhile(photo):
                    report.skipped[name] = reason
                    continue
                try:
                    path = _write_sidecar(journal, photo, location.proposal)
                except PlacewiseError as error:
                    report.skipped[name] = error.detail
                except OSError as error:
                    if error.errno not in ERRORS_OF_ONE_FILE:
                        raise
                    report.skipped[name] = f"can't be written: {error.strerror}"
                else:
                    report.written.append(utf8_path(path.relative_to(self.folder)))
        return report

    def undo(self) -> UndoReport:
        """Restore the files; see `undo_journal.undo`."""
        return undo(self.folder)

    def _change_meanwhile(self, photo: Path) -> str | None:
        """Return why a photo needs no position any more; the searches may have taken minutes."""
        if not photo.exists():
            return "was moved or deleted meanwhile"
        if not read_photo(self.folder, photo).is_unlocated:
            return "got coordinates meanwhile"
        return None


def _write_sidecar(journal: UndoJournal, photo: Path, proposal: Proposal) -> Path:
    """Add the position to the sidecar of a photo, or to a new one; return its path."""
    path = next(iter(find_sidecars(photo)), sidecar_path(photo))
    existing = path.read_bytes() if path.is_file() else None  # reading a FIFO would wait for ever
    at = proposal.latitude, proposal.longitude
    content = add_position(existing, *at, proposal.radius_68_m, proposal.heading)
    journal.write(path, content, existing)
    return path
