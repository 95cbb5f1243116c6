"""Where the photos of a folder were taken: from a CSV, or from `@UTM@` file names.

EXIF is read by the server, and fills what is not said here.
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
    path: Path
    fields: dict[str, str]
    """What is said of it, in the upload form's names."""
    name: str | None = None
    """What it is called, where that is not its file's name."""


def find_photos(
    folder: Path, table: Path | None, utm_zone: str | None, *, places_by_folder: bool = False
) -> list[LocalPhoto]:
    """Every photo below the folder, in the order of the paths, with what is said of it.

    With `places_by_folder`, the name of the folder that a photo lies in is its place, unless the
    table says another; photos directly in `folder` have none.

    Raises InvalidRequest for a table that names a photo that is not there, and for coordinates
    that can't be read.
    """
    paths = list_photos(folder)
    said = _read_csv_fields(folder, table, set(paths)) if table else {}
    found = []
    for path in paths:
        fields = upload_fields_of_file_name(path.name, utm_zone)
        if places_by_folder and path.parent != folder:
            fields["place"] = path.parent.name
        found.append(LocalPhoto(path, {**fields, **said.get(path, {})}))
    return found


def read_photo_manifest(manifest: Path, data: bytes) -> list[LocalPhoto]:
    """The photos that the lines of a JSONL manifest name, relative to where it lies.

    Raises InvalidRequest (`bad_manifest`), also for a photo that is not there.
    """
    found = []
    missing = []
    for line in read_jsonl_manifest(data, str(manifest)):
        path = manifest.parent / line.name
        if not path.is_file():
            missing.append((line.line, f"there is no photo {path}"))
        found.append(
            LocalPhoto(path, {**upload_fields_of_file_name(path.name, None), **line.fields})
        )
    if missing:
        raise bad_lines_error("bad_manifest", str(manifest), missing[:MAX_REPORTED_LINES])
    if not found:
        raise InvalidRequest("no_photos", f"{manifest} has no line.")
    return found


def list_photos(folder: Path) -> list[Path]:
    """Every photo below the folder, in order; InvalidRequest (`no_photos`) where there is none."""
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
            f"There is no photo ({', '.join(sorted(PHOTO_SUFFIXES))}) below {folder}.",
        )
    return paths


def _read_csv_fields(folder: Path, table: Path, paths: set[Path]) -> dict[Path, dict[str, str]]:
    try:
        data = table.read_bytes()
    except OSError as error:
        raise InvalidRequest("bad_table", f"Can't read {table}: {error}") from error
    said = {}
    for row in read_csv_manifest(data, str(table)):
        path = folder / row.name
        if path not in paths:
            raise bad_lines_error(
                "bad_table", str(table), [(row.line, f"there is no photo {path}")]
            )
        said[path] = row.fields
    return said
