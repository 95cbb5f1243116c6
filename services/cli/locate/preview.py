"""The last searches of a library, kept so that `--write` writes what the preview has shown.

They are a file below PLACEWISE_HOME, because a preview writes nothing into a folder itself. The
map may have changed between the two, or an evaluation may have ended: another search would give
other proposals, and repeat minutes of work.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from services.cli.locate.library import LibraryPhoto
from services.cli.output import refuse_unwritable
from shared.config.private_files import make_private_folder, write_private
from shared.geotagging.evidence import PictureEvidence

KEPT_FOR = timedelta(hours=24)


@dataclass(frozen=True, slots=True)
class SearchedPhoto:
    """What a search of the map says about a photo."""

    evidence: PictureEvidence | None = None
    place: str | None = None
    """finest label of the estimate"""
    place_probability: float | None = None
    error: str | None = None
    """why the photo could not be searched with"""


@dataclass(frozen=True, slots=True)
class Preview:
    """The searches of a library's photos and the proposals that were accepted."""

    searched_at: datetime
    searches: Mapping[str, tuple[str, SearchedPhoto]]
    """by name: state of the photo, and its search"""
    accepted: Mapping[str, Sequence[float | str]]
    """by name: latitude, longitude and place, as far as they are known"""

    def search_of(self, photo: LibraryPhoto) -> SearchedPhoto | None:
        """Return the search of a photo that has not changed since."""
        state, searched = self.searches.get(photo.name, ("", None))
        return searched if state == photo.state else None


PREVIEW = TypeAdapter(Preview)


def preview_file(home: Path, identity: str, server: str | None, map_name: str | None) -> Path:
    """Return the file of a library's preview with a map of a server; None is the default one."""
    key = json.dumps([identity, server, map_name])
    return home / "locate" / f"{hashlib.sha256(key.encode()).hexdigest()}.json"


def read_preview(file: Path) -> Preview | None:
    """Return a preview; None if there is none, or it is older than a day or of another release."""
    try:
        preview = PREVIEW.validate_json(file.read_bytes())
    except (OSError, ValidationError):
        return None
    return preview if datetime.now(UTC) - preview.searched_at < KEPT_FOR else None


def write_preview(file: Path, preview: Preview) -> None:
    """Write a preview, and delete those that are too old.

    Raises:
        Misconfigured: `out_unwritable`.
    """
    oldest = (datetime.now(UTC) - KEPT_FOR).timestamp()
    with refuse_unwritable(file):
        make_private_folder(file.parent)
        for other in file.parent.glob("*.json"):
            if other.stat().st_mtime < oldest:
                other.unlink(missing_ok=True)
        write_private(file, PREVIEW.dump_json(preview).decode())
