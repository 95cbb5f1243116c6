"""A folder as a library: accepted proposals are written into XMP sidecars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from services.cli.ingest.local_headers import find_sidecars
from services.cli.locate.folder import read_folder, read_photo
from services.cli.locate.library import LibraryPhoto, LocatedPhoto, UndoReport, WriteReport
from services.cli.locate.sidecars import (
    add_position,
    has_estimate,
    remove_position,
    replace_sidecar,
    sidecar_path,
)
from services.cli.output import printable_path, refuse_unwritable, utf8_path
from shared.errors import NotFound, PlacewiseError
from shared.geotagging.fusion import Proposal


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
        path = next(iter(find_sidecars(photo)), sidecar_path(photo))
        with refuse_unwritable(path):
            existing = path.read_bytes() if path.is_file() else None
            at = proposal.latitude, proposal.longitude
            content = add_position(existing, *at, proposal.radius_68_m, proposal.heading)
            replace_sidecar(self.folder, path, content, existing)
        return path
