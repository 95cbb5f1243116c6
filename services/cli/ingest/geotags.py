"""Local photos with their metadata: from a CSV table, a JSONL manifest or `@UTM@` file names.

The server reads EXIF and XMP itself and uses them for every field that is not given here.
"""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

from services.cli.ingest.local_headers import (
    dated_photo,
    find_sidecars,
    in_time_zone,
    parse_time_zone,
    read_local_header,
    read_sidecar,
)
from services.cli.ingest.photo_archive import is_archive, unpack_archive
from services.cli.output import Json, print_note, printable_path, utf8_path
from shared.errors import InvalidRequest
from shared.geotagging.evidence import add_time_zones
from shared.imaging.capture_place import is_null_island
from shared.imaging.file_formats import PHOTO_SUFFIXES
from shared.imaging.photo_header import PhotoHeader
from shared.ingest.photo_metadata import (
    MAX_REPORTED_LINES,
    bad_lines_error,
    read_csv_manifest,
    read_jsonl_manifest,
)
from shared.utm_filenames import upload_fields_of_file_name

HEADER_FIELDS = ("latitude", "longitude", "altitude", "heading", "captured_at")


@dataclass(frozen=True, slots=True)
class LocalPhoto:
    """A photo file with the metadata that is uploaded with it."""

    path: Path
    fields: dict[str, str]
    """Form fields of `POST /upload`."""
    name: str | None = None
    """Name to store; None for the file's own name."""
    relative_path: str | None = None
    """Path in the folder that is indexed."""
    sidecars: Mapping[str, bytes] = field(default_factory=dict)
    """XMP, and JSON of Google Takeout, by path"""

    def content(self) -> Path | BinaryIO:
        """Return the file, or what was fetched of a photo that is none. Raises PlacewiseError."""
        return self.path


def find_local_sources(sources: Sequence[str]) -> list[Path] | None:
    """Return the folders, photos and archives; None if a source is none."""
    paths = list(map(Path, sources))
    return paths if all(p.is_dir() or _is_photo(p) or is_archive(p) for p in paths) else None


def _is_photo(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in PHOTO_SUFFIXES


@dataclass(frozen=True, slots=True)
class LocalSource:
    """A folder or a photo."""

    path: Path
    table: Path | None = None
    """An archive's own table; its names are relative to its folder."""

    @classmethod
    def open(cls, path: Path, stack: contextlib.ExitStack) -> LocalSource:
        """Unpack an archive into a temporary folder, which the stack deletes."""
        if path.is_dir() or _is_photo(path):
            return cls(path)
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="placewise-"))
        folder = Path(scratch, path.name)
        folder.mkdir()
        return cls(folder, unpack_archive(path, folder))


def count_other_files(folder: Path) -> Counter[str]:
    """Count the files of a folder that are no photos by suffix (`.mov`), without hidden ones."""
    suffixes = (path.suffix.lower() for path in _list_files(folder))
    return Counter(suffix for suffix in suffixes if suffix not in PHOTO_SUFFIXES)


def find_photos(
    source: Path,
    table: Path | None,
    utm_zone: str | None,
    *,
    own_table: Path | None = None,
    places_by_folder: bool = False,
) -> list[LocalPhoto]:
    """Find the photos below a folder, sorted by path, or one photo.

    Args:
        source: A photo, or a folder, which is searched recursively.
        own_table: CSV file or JSONL manifest in the folder, with names relative to its own folder.
        table: CSV file with metadata; it takes precedence over names of files and folders.
        utm_zone: Zone for `@UTM@` file names that don't contain it, such as `32T`.
        places_by_folder: Use the name of a photo's parent folder as its place label. Photos
            directly in `source`, and single photos, get none.

    Raises:
        InvalidRequest: The table refers to a photo that does not exist, or contains coordinates
            that can't be parsed; `no_photos` if the folder contains none.
    """
    folder = source if source.is_dir() else source.parent
    found = [source] if source != folder else list_photos(folder)
    own_fields = _read_table(own_table.parent, own_table, set(found)) if own_table else {}
    table_fields = _read_table(folder, table, set(found)) if table else {}
    photos = []
    for path in found:
        fields = upload_fields_of_file_name(path.name, utm_zone)
        if places_by_folder and path.parent != folder:
            fields["place"] = path.parent.name
        photos.append(
            LocalPhoto(
                path,
                {**fields, **own_fields.get(path, {}), **table_fields.get(path, {})},
                relative_path=utf8_path(path.relative_to(folder)),
                sidecars={utf8_path(each): read_sidecar(each) for each in find_sidecars(path)},
            )
        )
    return photos


@dataclass(slots=True)
class HeaderReport:
    """What the headers of photos say that are about to be uploaded."""

    without_coordinates: int = 0
    without_time_zone: int = 0
    """Photos whose time is that of a clock, taken as UTC."""
    not_understood: list[Json] = field(default_factory=list)
    """Photos with coordinates that are not used: path, reason."""


def add_local_headers(
    photos: Sequence[LocalPhoto], time_zone: str | None
) -> tuple[list[LocalPhoto], HeaderReport]:
    """Add the fields that the server can't read from a photo alone.

    These are the place and time in its sidecars, and the time in UTC if the zone of its clock
    follows from other photos by the same camera, or is given.

    Raises:
        InvalidRequest: `bad_time_zone`.
    """
    zone = parse_time_zone(time_zone) if time_zone else None
    headers = []
    for photo in photos:
        own = whole = PhotoHeader(0, 0)
        with contextlib.suppress(OSError), photo.path.open("rb") as file:  # its upload reports it
            own = read_local_header(file)
            whole = read_local_header(file, photo.sidecars.values()) if photo.sidecars else own
        headers.append((own, whole))
    dated = add_time_zones(
        [dated_photo(str(number), whole) for number, (_, whole) in enumerate(headers)]
    )
    if zone is not None:
        dated = [in_time_zone(each, zone) for each in dated]
    report = HeaderReport()
    complete = []
    for photo, (own, whole), each in zip(photos, headers, dated, strict=True):
        values = {name: getattr(whole, name) for name in HEADER_FIELDS} | {"captured_at": each.time}
        added = {
            name: value.isoformat() if isinstance(value, datetime) else repr(value)
            for name, value in values.items()
            if value is not None and value != getattr(own, name)
        }
        if _has_place(photo.fields):
            added = {n: text for n, text in added.items() if n not in ("latitude", "longitude")}
        elif whole.gps_error is not None:
            found = {"path": utf8_path(photo.path), "reason": whole.gps_error}
            report.not_understood.append(found)
        elif whole.latitude is None and whole.width:
            report.without_coordinates += 1
        is_local = each.time is not None and not each.time_zone_is_known
        report.without_time_zone += is_local and "captured_at" not in photo.fields
        complete.append(replace(photo, fields={**added, **photo.fields}))
    return complete, report


def read_photo_manifest(manifest: Path, data: bytes) -> list[LocalPhoto]:
    """Read the photos listed in a JSONL manifest.

    Args:
        manifest: Path of the manifest; file names in it are relative to its folder.

    Raises:
        InvalidRequest: `bad_manifest` for invalid lines and for photos that don't exist;
            `no_photos` for an empty manifest.
    """
    photos = []
    missing = []
    for line in read_jsonl_manifest(data, str(manifest)):
        possible = list(_possible_paths(manifest.parent, line.name))
        path = next((path for path in possible if path.is_file()), possible[0])
        if not path.is_file():
            missing.append((line.line, f"photo {path} does not exist"))
        photos.append(
            LocalPhoto(
                path,
                {**upload_fields_of_file_name(path.name, None), **line.fields},
                relative_path=line.name,
                sidecars={utf8_path(each): read_sidecar(each) for each in find_sidecars(path)},
            )
        )
    if missing:
        raise bad_lines_error("bad_manifest", str(manifest), missing[:MAX_REPORTED_LINES])
    if not photos:
        raise InvalidRequest("no_photos", f"The manifest {manifest} is empty.")
    return photos


def list_photos(folder: Path) -> list[Path]:
    """List the photos below a folder, sorted; hidden files are left out.

    Folders that can't be read are named on stderr.

    Raises:
        InvalidRequest: `no_photos` if there is none.
    """
    files = _list_files(folder, _note_unreadable)
    paths = sorted((p for p in files if p.suffix.lower() in PHOTO_SUFFIXES), key=_name_order)
    if not paths:
        raise InvalidRequest(
            "no_photos",
            f"No photos ({', '.join(sorted(PHOTO_SUFFIXES))}) found below {folder}.",
        )
    return paths


def _read_table(folder: Path, table: Path, paths: set[Path]) -> dict[Path, dict[str, str]]:
    try:
        data = table.read_bytes()
    except OSError as error:
        raise InvalidRequest("bad_table", f"Can't read {table}: {error}") from error
    read = read_jsonl_manifest if table.suffix == ".jsonl" else read_csv_manifest
    fields = {}
    for row in read(data, str(table)):
        path = next((path for path in _possible_paths(folder, row.name) if path in paths), None)
        if path is None:
            raise bad_lines_error(
                "bad_table", str(table), [(row.line, f"photo {folder / row.name} does not exist")]
            )
        fields[path] = row.fields
    return fields


def _has_place(fields: Mapping[str, str]) -> bool:
    """Return whether the fields have coordinates, right or wrong; 0, 0 are none."""
    with contextlib.suppress(ValueError):
        return not is_null_island(
            float(fields.get("latitude", 0)), float(fields.get("longitude", 0))
        )
    return True


def _possible_paths(folder: Path, name: str) -> Iterator[Path]:
    """Yield the paths that a table may mean: of another system, or with composed characters."""
    for slashes in (name, name.replace("\\", "/")):
        yield folder / slashes
        for form in ("NFC", "NFD"):
            yield folder / unicodedata.normalize(form, slashes)


def _list_files(folder: Path, on_error: Callable[[OSError], None] | None = None) -> Iterator[Path]:
    """Yield the files below a folder without hidden ones; links to folders are not followed."""
    for parent, folders, names in os.walk(folder, onerror=on_error):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from filter(Path.is_file, (Path(parent, n) for n in names if not n.startswith(".")))


def _note_unreadable(error: OSError) -> None:
    print_note(f"Can't read the folder {printable_path(Path(error.filename))}: {error.strerror}")


def _name_order(path: Path) -> tuple[object, ...]:
    """Return the key that sorts paths: `a (1).jpg`, a copy, comes after `a.jpg`."""
    copy = re.fullmatch(r"(.*?) ?\((\d{1,9})\)", path.stem)
    stem, number = (copy[1], int(copy[2])) if copy else (path.stem, 0)
    return (*path.parent.parts, stem), number, path.suffix
