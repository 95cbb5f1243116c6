"""Local photos with their metadata: from a CSV table, a JSONL manifest or `@UTM@` file names.

The server reads EXIF itself and uses it for every field that is not given here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from shared.datasets.utm_filenames import upload_fields_of_file_name
from shared.errors import InvalidRequest
from shared.imaging.file_formats import PHOTO_SUFFIXES
from shared.ingest.photo_metadata import (
    MAX_REPORTED_LINES,
    bad_lines_error,
    read_csv_manifest,
    read_jsonl_manifest,
)


@dataclass(frozen=True, slots=True)
class LocalPhoto:
    """A photo file with the metadata that is uploaded with it."""

    path: Path
    fields: dict[str, str]
    """Form fields of `POST /upload`."""
    name: str | None = None
    """Name to store; None for the file's own name."""


def find_photos(
    folder: Path, table: Path | None, utm_zone: str | None, *, places_by_folder: bool = False
) -> list[LocalPhoto]:
    """Find the photos below a folder, sorted by path, with their metadata.

    Args:
        folder: Searched recursively.
        table: CSV file with metadata; it takes precedence over names of files and folders.
        utm_zone: Zone for `@UTM@` file names that don't contain it, such as `32T`.
        places_by_folder: Use the name of a photo's parent folder as its place label. Photos
            directly in `folder` get none.

    Raises:
        InvalidRequest: The table refers to a photo that does not exist, or contains coordinates
            that can't be parsed; `no_photos` if the folder contains none.
    """
    paths = list_photos(folder)
    table_fields = _read_csv_fields(folder, table, set(paths)) if table else {}
    photos = []
    for path in paths:
        fields = upload_fields_of_file_name(path.name, utm_zone)
        if places_by_folder and path.parent != folder:
            fields["place"] = path.parent.name
        photos.append(LocalPhoto(path, {**fields, **table_fields.get(path, {})}))
    return photos


def read_photo_manifest(manifest: Path, data: bytes) -> list[LocalPhoto]:
    """Read the photos listed in a JSONL manifest.

    Args:
        manifest: Path of the manifest; file names in it are relative to its folder.
        data: Content of the manifest.

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
            LocalPhoto(path, {**upload_fields_of_file_name(path.name, None), **line.fields})
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
