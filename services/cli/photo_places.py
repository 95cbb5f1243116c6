"""Where the photos of a folder were taken: from a CSV, or from `@UTM@` file names.

EXIF is read by the server, and fills what is not said here.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

from shared.datasets.utm_names import fields_of_name
from shared.errors import InvalidRequest

SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff"}
CSV_FILE_COLUMNS = ("filename", "file", "path")
CSV_COLUMNS = ("latitude", "longitude", "heading", "captured_at", "place", "tags")


@dataclass(frozen=True, slots=True)
class FoundPhoto:
    path: Path
    fields: dict[str, str]
    """What is said of it, in the upload form's names."""
    name: str | None = None
    """What it is called, where that is not its file's name."""


def find_photos(
    folder: Path, table: Path | None, utm_zone: str | None, *, places_by_folder: bool = False
) -> list[FoundPhoto]:
    """Every photo below the folder, in the order of the paths, with what is said of it.

    With `places_by_folder`, the name of the folder that a photo lies in is its place, unless the
    table says another; photos directly in `folder` have none.

    Raises InvalidRequest for a table that names a photo that is not there, and for coordinates
    that can't be read.
    """
    paths = sorted(
        path
        for path in folder.rglob("*")
        if path.is_file() and path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
    )
    if not paths:
        raise InvalidRequest(
            "no_photos",
            f"There is no photo ({', '.join(sorted(SUFFIXES))}) below {folder}.",
        )
    said = _read_table(folder, table, set(paths)) if table else {}
    found = []
    for path in paths:
        fields = fields_of_name(path.name, utm_zone)
        if places_by_folder and path.parent != folder:
            fields["place"] = path.parent.name
        found.append(FoundPhoto(path, {**fields, **said.get(path, {})}))
    return found


def _read_table(folder: Path, table: Path, paths: set[Path]) -> dict[Path, dict[str, str]]:
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            columns = reader.fieldnames or []
            name_column = next((c for c in CSV_FILE_COLUMNS if c in columns), None)
            if name_column is None:
                raise InvalidRequest(
                    "bad_table",
                    f"{table} has no column {' or '.join(CSV_FILE_COLUMNS)}; "
                    f"beside it may stand {', '.join(CSV_COLUMNS)}. Its first line, read as "
                    f"separated by commas, is {', '.join(columns) or 'empty'}.",
                )
            unknown = [c for c in columns if c not in (name_column, *CSV_COLUMNS)]
            if unknown:
                raise InvalidRequest(
                    "bad_table",
                    f"{table}: the columns {', '.join(unknown)} mean nothing here. Known are "
                    f"{name_column}, {', '.join(CSV_COLUMNS)}: rename them, or take them out.",
                )
            said = {}
            for row in reader:
                path = folder / (row[name_column] or "")  # a short row has None
                if path not in paths:
                    raise InvalidRequest(
                        "bad_table",
                        f"{table}, line {reader.line_num}: there is no photo {path}.",
                    )
                said[path] = {c: row[c] for c in CSV_COLUMNS if row.get(c)}
            return said
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidRequest("bad_table", f"Can't read {table}: {error}") from error
