"""Photo libraries whose photos are located: what `locate` needs of a folder or of Immich."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Protocol

from shared.geotagging.evidence import DatedPhoto
from shared.geotagging.fusion import Proposal


@dataclass(frozen=True, slots=True)
class LibraryPhoto(DatedPhoto):
    """A photo of a library."""

    id: str = field(kw_only=True)
    """unique in the library, and the same in the next listing"""
    state: str = field(kw_only=True)
    """another one after its picture may have changed"""
    gps_error: str | None = field(default=None, kw_only=True)
    """why it may have coordinates although none are known"""

    @property
    def is_unlocated(self) -> bool:
        """Whether the photo certainly has no coordinates."""
        return self.latitude is None and self.gps_error is None


@dataclass(frozen=True, slots=True)
class LocatedPhoto:
    """The proposal for a photo without coordinates."""

    photo: LibraryPhoto
    proposal: Proposal | None
    place: str | None
    """finest label of the estimate"""
    place_probability: float | None
    error: str | None
    """why the photo could not be searched"""
    why_unknown: str = ""
    """what is shown if there is no proposal"""

    @property
    def probability(self) -> float:
        """Of the position, or of the place if there is none."""
        if self.proposal is not None:
            return self.proposal.probability
        return self.place_probability or 0.0

    def shown(self) -> list[float | str]:
        """Return coordinates and place, as far as they are known, rounded as they are shown."""
        found = self.proposal
        coordinates = [round(found.latitude, 6), round(found.longitude, 6)] if found else []
        return [*coordinates, *([self.place] if self.place else [])]


@dataclass(frozen=True, slots=True)
class WriteReport:
    """What was written: names of photos, or of files relative to a folder."""

    written: list[str] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    """reasons by photo"""


@dataclass(frozen=True, slots=True)
class UndoReport:
    """What an undo has done: names of photos, or of files relative to a folder."""

    restored: list[str] = field(default_factory=list)
    """have the former content, or coordinates, again"""
    removed: list[str] = field(default_factory=list)
    """did not exist, or had no coordinates, before"""
    changed_since: list[str] = field(default_factory=list)
    """changed by something else since; they are left as they are"""


class PhotoLibrary(Protocol):
    """Where photos are and where accepted proposals go.

    What `write` has written can be undone, also after the process was killed. Neither changes a
    photo that something else has changed meanwhile.
    """

    @property
    def identity(self) -> str:
        """What tells the library from others on this machine."""

    @property
    def written_are(self) -> str:
        """What is written, in the plural, such as files."""

    @property
    def undo_command(self) -> str:
        """The command line that undoes what is written."""

    def list_photos(self) -> Sequence[LibraryPhoto]:
        """List all photos, with and without coordinates, with unique names."""

    def fetch(self, photo: LibraryPhoto) -> Path | BinaryIO:
        """Return a photo's picture: its file, or the open bytes of an image.

        Raises:
            PlacewiseError: It can't be fetched.
        """

    def write(self, located: Sequence[LocatedPhoto]) -> WriteReport:
        """Write the positions of photos that still have none."""

    def undo(self) -> UndoReport:
        """Restore what all calls of `write` have changed.

        Raises:
            NotFound: `nothing_to_undo`.
        """
