"""An Immich user's images as a library."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

from filelock import FileLock, Timeout

from services.cli.immich.api import Coordinates, ImmichApi
from services.cli.locate.folder import set_clocks
from services.cli.locate.library import LibraryPhoto, LocatedPhoto, UndoReport, WriteReport
from services.cli.locate.undo_journal import append_to_journal, read_journal
from services.cli.output import Json
from shared.config.private_files import make_private_folder
from shared.errors import Conflict, Forbidden, NotFound, Unprocessable
from shared.imaging.capture_place import is_null_island

NOWHERE: Coordinates = (0.0, 0.0)
"""What takes the place of coordinates that can't be taken away: no place, also for Immich"""
SAME_DEGREES = 1e-6
"""Immich stores coordinates in a sidecar, too, where they are rounded"""


class ImmichLibrary:
    """The images of the user that the key belongs to; implements `PhotoLibrary`.

    Images of partners, videos, people and what is in the trash or the locked folder are left out.

    Args:
        folder: Where the journal is kept.
    """

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

    def list_photos(self) -> Sequence[LibraryPhoto]:
        """List the images; their names begin with that of an album that they are in."""
        albums = {
            image["id"]: album["albumName"]
            for album in self._api.albums()
            for image in self._api.images(albumIds=[album["id"]])
        }
        own = {
            image["id"]: image
            for image in self._api.images()
            if image["ownerId"] == self._user_id
            and not (image["isTrashed"] or image["visibility"] == "locked")
        }
        photos: dict[str, LibraryPhoto] = {}
        for image in own.values():
            photo = _library_photo(image, albums.get(image["id"], ""))
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
        with self._exclusive():
            for position, photos in same_position.items():
                unchanged = []
                for photo in photos:
                    asset = self._api.asset(photo.id)
                    if asset is None or asset["isTrashed"]:
                        report.skipped[photo.name] = "was deleted meanwhile"
                    elif _coordinates(asset):
                        report.skipped[photo.name] = "got coordinates meanwhile"
                    else:
                        unchanged.append(photo)
                        self._record(photo, _stored_pair(asset), position)
                if not unchanged:
                    continue
                try:
                    self._api.set_coordinates([photo.id for photo in unchanged], position)
                except (NotFound, Unprocessable, Forbidden) as error:
                    report.skipped.update({photo.name: error.detail for photo in unchanged})
                else:
                    report.written.extend(photo.name for photo in unchanged)
        return report

    def undo(self) -> UndoReport:
        """Restore the coordinates; images that had none get 0, 0, which Immich takes for none."""
        report = UndoReport()
        if not self._journal.exists():
            raise NotFound("nothing_to_undo", "Nothing was written into this library.")
        with self._exclusive():
            lines = read_journal(self._journal, _check_line)
            written: dict[str, list[Json]] = {}
            for line in lines:
                written.setdefault(line["id"], []).append(line)
            for asset_id, changes in written.items():
                asset = self._api.asset(asset_id)
                if asset is None:
                    continue  # deleted: there is nothing to restore
                name, before = changes[0]["name"], _pair(changes[0]["before"])
                present = _coordinates(asset)
                if _is_same(present, _place(before)):
                    continue
                if not any(_is_same(present, _pair(line["after"])) for line in changes):
                    report.changed_since.append(name)
                    continue
                self._api.set_coordinates([asset_id], before or NOWHERE)
                (report.restored if before else report.removed).append(name)
            if not report.changed_since:
                self._journal.unlink()
        return report

    def _record(self, photo: LibraryPhoto, before: Coordinates | None, after: Coordinates) -> None:
        line = {"id": photo.id, "name": photo.name, "before": before, "after": after}
        append_to_journal(self._journal, line)

    @contextlib.contextmanager
    def _exclusive(self) -> Iterator[None]:
        make_private_folder(self._journal.parent)
        try:
            with FileLock(self._journal.with_suffix(".lock"), timeout=0):
                self._end_last_line()
                yield
        except Timeout as error:
            raise Conflict(
                "locate_in_progress", "Another `placewise immich` writes to this library."
            ) from error

    def _end_last_line(self) -> None:
        """Take away an incomplete last line, which a killed process has left."""
        if self._journal.exists():
            complete, _, rest = self._journal.read_bytes().rpartition(b"\n")
            if rest:
                with self._journal.open("r+b") as file:
                    file.truncate(len(complete) + 1 if complete else 0)


def _library_photo(image: Json, album: str) -> LibraryPhoto:
    """Return what Immich says about when, where and by which camera an image was taken."""
    exif = image.get("exifInfo") or {}
    clock, taken = _time(image["localDateTime"]), None
    offset = None
    if exif.get("dateTimeOriginal"):
        taken = clock  # as the camera showed it
        if exif.get("timeZone"):
            taken = _time(exif["dateTimeOriginal"])
            offset = clock - taken
    picture = [image["checksum"], *([image["thumbhash"]] if image.get("isEdited") else [])]
    latitude, longitude = _coordinates(image) or (None, None)
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
    time = datetime.fromisoformat(text)
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def _stored_pair(asset: Json) -> Coordinates | None:
    exif = asset.get("exifInfo") or {}
    return _pair((exif.get("latitude"), exif.get("longitude")))


def _coordinates(asset: Json) -> Coordinates | None:
    return _place(_stored_pair(asset))


def _place(pair: Coordinates | None) -> Coordinates | None:
    """Return the coordinates; 0, 0 are none."""
    return None if pair is None or is_null_island(*pair) else pair


def _is_same(one: Coordinates | None, other: Coordinates | None) -> bool:
    if one is None or other is None:
        return one is other
    return all(abs(a - b) <= SAME_DEGREES for a, b in zip(one, other, strict=True))


def _pair(value: Any) -> Coordinates | None:
    if value is None or None in value:
        return None
    latitude, longitude = value
    return float(latitude), float(longitude)


def _check_line(line: Json) -> None:
    if not isinstance(line["id"], str) or not isinstance(line["name"], str):
        raise TypeError
    _pair(line["before"])
    _pair(line["after"])
