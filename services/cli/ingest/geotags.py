"""Local photos with their metadata: from a CSV table, a JSONL manifest or `@UTM@` file names.

The server reads EXIF itself and uses it for every field that is not given here.
"""

from __future__ import annotations

import contextlib
import glob
import io
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from services.cli.ingest.photo_archive import ArchivedFile, PhotoArchive, is_archive
from services.cli.output import utf8_path
from shared.errors import InvalidRequest, PlacewiseError
from shared.imaging.file_formats import PHOTO_SUFFIXES
from shared.imaging.photo_header import read_photo_header
from shared.ingest.photo_metadata import (
    MAX_REPORTED_LINES,
    bad_lines_error,
    read_csv_manifest,
    read_jsonl_manifest,
)
from shared.utm_filenames import upload_fields_of_file_name


@dataclass(frozen=True, slots=True)
class LocalPhoto:
    """A photo file, or a photo in an archive, with the metadata that is uploaded with it."""

    path: Path
    """Of a photo in an archive: the archive's path and the photo's name in it."""
    fields: dict[str, str]
    """Form fields of `POST /upload`."""
    name: str | None = None
    """Name to store; None for the file's own name."""
    relative_path: str | None = None
    """Path in the folder or archive that is indexed."""
    archived: ArchivedFile | None = None
    """The photo in its archive."""

    @property
    def file(self) -> Path:
        """The file with its bytes: the photo itself, or its archive."""
        return self.path if self.archived is None else self.archived.archive.path

    def open(self) -> BinaryIO:
        """Open the photo. Raises OSError, and what `ArchivedFile.read` raises."""
        if self.archived is None:
            return self.path.open("rb")
        return io.BytesIO(self.archived.read())


def find_local_sources(sources: Sequence[str]) -> list[Path] | None:
    """Expand patterns, and return the folders, photos and archives; None if a source is none.

    Raises:
        InvalidRequest: `no_photos` if a pattern matches nothing.
    """
    paths: list[Path] = []
    for source in sources:
        found = [Path(source)]
        if not found[0].exists() and glob.has_magic(source):
            found = sorted(map(Path, glob.glob(source, recursive=True)))  # noqa: PTH207 absolute, too
            if not found:
                raise InvalidRequest("no_photos", f"No file matches the pattern {source}.")
        paths += found
    return paths if all(p.is_dir() or _is_photo(p) or is_archive(p) for p in paths) else None


def _is_photo(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in PHOTO_SUFFIXES


def open_local_source(path: Path, stack: contextlib.ExitStack) -> Path | PhotoArchive:
    """Open the path if it is an archive, which the stack closes; else return it."""
    if path.is_dir() or _is_photo(path):
        return path
    return stack.enter_context(PhotoArchive(path))


def count_other_files(source: Path | PhotoArchive) -> Counter[str]:
    """Count the files of a folder or archive that are no photos by their suffix, such as `.mov`.

    Hidden files are left out.
    """
    if isinstance(source, PhotoArchive):
        return source.other_files
    return Counter(
        path.suffix.lower()
        for path in source.rglob("*")
        if path.suffix.lower() not in PHOTO_SUFFIXES
        and not path.name.startswith(".")
        and path.is_file()
    )


def has_coordinates(photo: LocalPhoto) -> bool:
    """Return whether a photo has coordinates in its fields or its EXIF.

    A file that can't be read counts as one with: its upload reports what is wrong with it.
    """
    if "latitude" in photo.fields:
        return True
    try:
        with photo.open() as file:
            return read_photo_header(file, sys.maxsize).latitude is not None
    except (OSError, PlacewiseError):
        return True


def find_photos(
    source: Path | PhotoArchive,
    table: Path | None,
    utm_zone: str | None,
    *,
    places_by_folder: bool = False,
) -> list[LocalPhoto]:
    """Find the photos below a folder, sorted by path, of an archive, or one photo.

    Args:
        source: A photo, a folder, which is searched recursively, or an open archive, of which the
            own table is read as well.
        table: CSV file with metadata; it takes precedence over names of files and folders.
        utm_zone: Zone for `@UTM@` file names that don't contain it, such as `32T`.
        places_by_folder: Use the name of a photo's parent folder as its place label. Photos
            directly in `source`, and single photos, get none.

    Raises:
        InvalidRequest: The table refers to a photo that does not exist, or contains coordinates
            that can't be parsed; `no_photos` if the folder contains none.
    """
    found: list[tuple[Path, ArchivedFile | None]]
    table_fields: dict[Path, dict[str, str]] = {}
    if isinstance(source, PhotoArchive):
        folder = source.path
        found = [(folder / photo.name, photo) for photo in source.photos]
        table_fields = {folder / name: fields for name, fields in source.table_fields().items()}
    else:
        folder = source if source.is_dir() else source.parent
        found = [(path, None) for path in ([source] if source != folder else list_photos(folder))]
    if table is not None:
        csv_fields = _read_csv_fields(folder, table, {path for path, _ in found})
        table_fields |= {p: {**table_fields.get(p, {}), **csv_fields[p]} for p in csv_fields}
    photos = []
    for path, archived in found:
        fields = upload_fields_of_file_name(path.name, utm_zone)
        if places_by_folder and path.parent != folder:
            fields["place"] = path.parent.name
        photos.append(
            LocalPhoto(
                path,
                {**fields, **table_fields.get(path, {})},
                relative_path=utf8_path(path.relative_to(folder)),
                archived=archived,
            )
        )
    return photos


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
        path = manifest.parent / line.name
        if not path.is_file():
            missing.append((line.line, f"photo {path} does not exist"))
        photos.append(
            LocalPhoto(
                path,
                {**upload_fields_of_file_name(path.name, None), **line.fields},
                relative_path=line.name,
            )
        )
    if missing:
        raise bad_lines_error("bad_manifest", str(manifest), missing[:MAX_REPORTED_LINES])
    if not photos:
        raise InvalidRequest("no_photos", f"The manifest {manifest} is empty.")
    return photos


def list_photos(folder: Path) -> list[Path]:
    """List the photos below a folder, sorted; hidden files are left out.

    Raises:
        InvalidRequest: `no_photos` if there is none.
    """
    paths = sorted(
        path
        for path in folder.rglob("*")
        if path.is_file()
        and path.suffix.lower() in PHOTO_SUFFIXES
        and not path.name.startswith(".")
    )
    if not paths:
        raise InvalidRequest(
            "no_photos",
            f"No photos ({', '.join(sorted(PHOTO_SUFFIXES))}) found below {folder}.",
        )
    return paths


def _read_csv_fields(folder: Path, table: Path, paths: set[Path]) -> dict[Path, dict[str, str]]:
    try:
        data = table.read_bytes()
    except OSError as error:
        raise InvalidRequest("bad_table", f"Can't read {table}: {error}") from error
    fields = {}
    for row in read_csv_manifest(data, str(table)):
        path = folder / row.name
        if path not in paths:
            raise bad_lines_error(
                "bad_table", str(table), [(row.line, f"photo {path} does not exist")]
            )
        fields[path] = row.fields
    return fields
