"""An Immich user's images as a library."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from filelock import FileLock, Timeout
from pydantic import BaseModel, ValidationError

from services.cli.immich.api import Coordinates, ImmichApi
from services.cli.locate.folder import set_clocks
from services.cli.locate.library import LibraryPhoto, LocatedPhoto, UndoReport, WriteReport
from services.cli.output import Json, printable_path
from shared.config.command_line import command_line
from shared.config.private_files import make_private_folder
from shared.errors import (
    Conflict,
    NotFound,
    PlacewiseError,
    TooManyRequests,
    Unavailable,
    Unprocessable,
)
from shared.imaging.capture_place import is_null_island

NOWHERE: Coordinates = (0.0, 0.0)
"""In place of coordinates that can't be taken away: no place, also when Immich reads metadata"""
SAME_DEGREES = 1e-6
"""Immich stores coordinates in a sidecar, too, where they are rounded"""


class _Change(BaseModel):
    """A line of the journal: the coordinates of an image before and after a write."""

    id: str
    name: str
    before: Coordinates | None
    after: Coordinates


class ImmichLibrary:
    """The images of the user that the key belongs to; implements `PhotoLibrary`.

    Images of partners, videos, people and what is in the trash or the locked folder are left out.

    Args:
        folder: Where the journal is kept.
    """

    written_are = "photos"

    def __init__(
        self,
        api: ImmichApi,
        folder: Path,
        time_zone: str | None = None,
        clock_offset_seconds: float = 0.0,
    ) -> None:
        self._api = api
        self._user_id = api.user_id()
        self._clocks = time_zone, clock_offset_seconds
        self._journal = folder / f"{self._user_id}.jsonl"

    @property
    def identity(self) -> str:
        """The user, whatever the address of the server is."""
        return f"immich:{self._user_id}"

    @property
    def undo_command(self) -> str:
        """That of `placewise immich`."""
        home = self._journal.parents[1]
        return command_line("immich", "--url", self._api.url, "--undo", home=home)

    def list_photos(self) -> Sequence[LibraryPhoto]:
        """List the images; their names begin with that of an album that they are in."""
        albums = {
            image["id"]: album["albumName"]
            for album in self._api.albums()
            for image in self._api.images(albumIds=[album["id"]], withExif=False)
        }
        own = {
            image["id"]: _library_photo(image, albums.get(image["id"], ""))
            for image in self._api.images()
            if image["ownerId"] == self._user_id
            and not (image["isTrashed"] or image.get("visibility") == "locked")
        }
        photos: dict[str, LibraryPhoto] = {}
        for photo in own.values():
            if photo.name in photos:
                photo = replace(photo, name=f"{photo.id}/{photo.name}")
            photos[photo.name] = photo
        return set_clocks(list(photos.values()), *self._clocks)

    def fetch(self, photo: LibraryPhoto) -> BinaryIO:
        """Download the preview."""
        return io.BytesIO(self._api.preview(photo.id))

    def write(self, located: Sequence[LocatedPhoto]) -> WriteReport:
        """Give the images coordinates, one call for all of the same position."""
        report = WriteReport()
        same_position: dict[Coordinates, list[LibraryPhoto]] = {}
        for each in located:
            if each.proposal is None:
                report.skipped[each.photo.name] = "has a place only, which Immich can't store"
                continue
            position = (each.proposal.latitude, each.proposal.longitude)
            same_position.setdefault(position, []).append(each.photo)
        with self._lock_journal():
            for position, photos in same_position.items():
                names = {}
                for photo in photos:
                    asset = self._api.asset(photo.id)
                    if asset is None or asset["isTrashed"]:
                        report.skipped[photo.name] = "was deleted meanwhile"
                    elif _place(former := _coordinates(asset)):
                        report.skipped[photo.name] = "got coordinates meanwhile"
                    else:
                        names[photo.id] = photo.name
                        change = _Change(
                            id=photo.id, name=photo.name, before=former, after=position
                        )
                        self._append_to_journal(change)
                try:
                    if names:
                        self._api.set_coordinates(list(names), position)
                except (Unavailable, TooManyRequests):
                    raise
                except PlacewiseError as error:
                    report.skipped.update(dict.fromkeys(names.values(), error.detail))
                else:
                    report.written.extend(names.values())
        return report

    def undo(self) -> UndoReport:
        """Restore the coordinates; images that had none get 0, 0, which are no place."""
        report = UndoReport()
        if not self._journal.exists():
            raise NotFound("nothing_to_undo", "Nothing was written into this library.")
        with self._lock_journal():
            changes: dict[str, list[_Change]] = {}
            for line in self._read_journal():
                changes.setdefault(line.id, []).append(line)
            for asset_id, (first, *later) in changes.items():
                asset = self._api.asset(asset_id)
                present = asset and _place(_coordinates(asset))
                if not present:
                    continue  # deleted, or without a place, as it was
                if not any(_is_same(present, line.after) for line in (first, *later)):
                    report.changed_since.append(first.name)
                    continue
                self._api.set_coordinates([asset_id], first.before or NOWHERE)
                (report.restored if first.before else report.removed).append(first.name)
            if not report.changed_since:
                self._journal.unlink()
        return report

    @contextlib.contextmanager
    def _lock_journal(self) -> Iterator[None]:
        """Hold the journal, without an incomplete last line, which a killed process has left."""
        make_private_folder(self._journal.parent)
        try:
            with FileLock(self._journal.with_suffix(".lock"), timeout=0):
                if self._journal.exists():
                    complete = self._journal.read_bytes().rfind(b"\n") + 1
                    os.truncate(self._journal, complete)
                yield
        except Timeout as error:
            raise Conflict(
                "locate_in_progress", "Another `placewise immich` writes to this library."
            ) from error

    def _read_journal(self) -> Iterator[_Change]:
        for number, line in enumerate(self._journal.read_bytes().splitlines(), start=1):
            try:
                yield _Change.model_validate_json(line)
            except ValidationError as error:
                raise Unprocessable(
                    "journal_damaged",
                    f"{printable_path(self._journal)}: line {number} can't be read.",
                ) from error

    def _append_to_journal(self, change: _Change) -> None:
        """Append a line, which is on the disk when the call returns."""
        with self._journal.open("ab") as file:
            file.write(change.model_dump_json().encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())


def _library_photo(image: Json, album: str) -> LibraryPhoto:
    """Return what Immich says about when, where and by which camera an image was taken."""
    exif = image.get("exifInfo") or {}
    clock = _time(image["localDateTime"])  # as the camera showed it
    taken = clock if exif.get("dateTimeOriginal") else None
    offset = None
    if taken and exif.get("timeZone"):
        taken = _time(exif["dateTimeOriginal"])
        offset = clock - taken
    # The checksum of a file in an external library is that of its path.
    picture = [image["checksum"], image["fileModifiedAt"]]
    picture += [image["thumbhash"]] if image.get("isEdited") else []
    latitude, longitude = _place(_coordinates(image)) or (None, None)
    return LibraryPhoto(
        f"{album}/{image['originalFileName']}" if album else image["originalFileName"],
        taken,
        offset is not None,
        " ".join(filter(None, (exif.get("make"), exif.get("model")))) or None,
        latitude,
        longitude,
        offset,
        id=image["id"],
        state=" ".join(map(str, picture)),
    )


def _time(text: str) -> datetime:
    return datetime.fromisoformat(text).replace(tzinfo=UTC)  # Immich writes all times in UTC


def _coordinates(asset: Json) -> Coordinates | None:
    exif = asset.get("exifInfo") or {}
    latitude, longitude = exif.get("latitude"), exif.get("longitude")
    return None if latitude is None or longitude is None else (latitude, longitude)


def _place(coordinates: Coordinates | None) -> Coordinates | None:
    """Return the coordinates; 0, 0 are none."""
    return None if coordinates is None or is_null_island(*coordinates) else coordinates


def _is_same(one: Coordinates, other: Coordinates) -> bool:
    return all(abs(a - b) <= SAME_DEGREES for a, b in zip(one, other, strict=True))
