"""Photo lists: CSV with positions, `.npy` arrays of paths, text files with one path per line.

Also reads positions from `@UTM@` file names and EXIF, and CSV tables by column names, with errors
that name file and line.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from lab.datasets.dataset import PHOTO_TABLE_HEADER, DatasetPhoto
from lab.datasets.ground_truth_files import read_names
from lab.datasets.utm_coordinates import add_utm_positions
from shared.errors import InvalidRequest, PlacewiseError, Unprocessable
from shared.imaging.photo_header import read_photo_header
from shared.utm_filenames import parse_utm_file_name

NUMBERED_NAME = re.compile(r"[A-Za-z]*[_-]?(\d{1,15})")
"""Stems of frames: `0000123`, `frame_0123`, `img-123`"""
UNLIMITED_PIXELS = 2**62  # no limit: only the header is read


def photo_from_filename(path: Path, name: str, place: str | None = None) -> DatasetPhoto:
    """Create a photo with the position of its `@UTM@` file name, or its number as a frame's.

    Raises InvalidRequest (`bad_coordinates`).
    """
    location = parse_utm_file_name(path.name)
    if location is None:
        numbered = NUMBERED_NAME.fullmatch(path.stem)
        return DatasetPhoto(path, name, place=place, frame=int(numbered[1]) if numbered else None)
    return DatasetPhoto(
        path,
        name,
        easting=location.east,
        northing=location.north,
        zone=location.zone,
        latitude=location.latitude,
        longitude=location.longitude,
        heading=location.heading,
        place=place,
        captured_at=location.captured_at,
    )


def add_exif_positions(photos: Iterable[DatasetPhoto]) -> list[DatasetPhoto]:
    """Add positions from EXIF to photos without one.

    Photos without EXIF, and unreadable ones, are returned unchanged.
    """
    return [photo if photo.easting is not None else _add_exif_position(photo) for photo in photos]


def _add_exif_position(photo: DatasetPhoto) -> DatasetPhoto:
    try:
        with photo.path.open("rb") as file:
            header = read_photo_header(file, UNLIMITED_PIXELS)
    except (OSError, Unprocessable):
        # Reported when the photo is decoded; here its position is unknown.
        return photo
    return replace(
        photo,
        zone=None,
        latitude=header.latitude,
        longitude=header.longitude,
        heading=header.heading,
    )


def read_table(path: Path, needed: Sequence[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the line number and the cells by column name of each row of a CSV file.

    `needed`: required columns; others are returned, too. Raises InvalidRequest: `missing_column`
    (which lists the existing columns), `bad_table`.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            columns = reader.fieldnames or []
            missing = [column for column in needed if column not in columns]
            if missing:
                raise InvalidRequest(
                    "missing_column",
                    f"{path} has no column {', '.join(missing)}. Its first line, separated by "
                    f"commas, is: {', '.join(columns) or 'empty'}.",
                    missing=missing,
                )
            for row in reader:
                line = reader.line_num
                if None in row or None in row.values():
                    raise bad_row_error(
                        path,
                        line,
                        f"it does not have the {len(columns)} cells of the first line",
                    )
                yield line, row
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidRequest("bad_table", f"Can't read {path}: {error}.") from error


def parse_integer(path: Path, line: int, row: dict[str, str], column: str) -> int:
    """Parse a cell as an integer; accepts `7.0`, as pandas writes integers."""
    value = parse_number(path, line, row, column)
    if value != int(value):
        raise bad_row_error(path, line, f"{column} {row[column]!r} is not an integer")
    return int(value)


def parse_number(path: Path, line: int, row: dict[str, str], column: str) -> float:
    """Parse a cell as a finite number; raises InvalidRequest (`bad_table`)."""
    try:
        value = float(row[column])
        if abs(value) < float("inf"):
            return value
    except ValueError:
        pass
    raise bad_row_error(path, line, f"{column} {row[column]!r} is not a number")


def bad_row_error(path: Path, line: int, reason: str) -> PlacewiseError:
    """Return the error for a row of a table that can't be used."""
    return InvalidRequest("bad_table", f"{path}, line {line}: {reason}.", line=line)


PATH_COLUMNS = ("path", "filename", "file")
COLUMN_ALIASES = {"lat": "latitude", "lon": "longitude", "UTMx": "easting", "UTMy": "northing"}
"""Canonical columns by the names that other datasets use"""
NUMBER_COLUMNS = ("latitude", "longitude", "easting", "northing", "heading")


def read_photo_list(path: Path, folder: Path | None = None) -> tuple[DatasetPhoto, ...]:
    """Read the photos of a list, in its order.

    Positions come from the columns of a CSV, from `@UTM@` file names, or from EXIF.

    Args:
        path: The list: `.csv`, `.npy`, or any other suffix for one path per line.
        folder: Folder that the paths are relative to; None for the list's own.

    Raises:
        InvalidRequest: `bad_list`, `bad_table`, `missing_column`, `bad_coordinates`.
    """
    root = path.parent if folder is None else folder
    match path.suffix.lower():
        case ".csv":
            photos = [
                _row(path, line, row, root, _path_column(path, row))
                for line, row in read_table(path, ())
            ]
        case ".npy":
            photos = [_photo_of_name(root, name) for name in read_names(path)]
        case _:
            photos = [_photo_of_name(root, name) for name in _lines(path)]
    if not photos:
        raise InvalidRequest("bad_list", f"{path} lists no photos.")
    return add_utm_positions(add_exif_positions(add_utm_positions(photos)))


def _photo_of_name(root: Path, name: str) -> DatasetPhoto:
    return photo_from_filename(root / name.lstrip("/"), name)


def _lines(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidRequest("bad_list", f"Can't read {path}: {error}.") from error
    return [line.strip() for line in lines if line.strip()]


def _path_column(path: Path, row: dict[str, str]) -> str:
    column = next((column for column in PATH_COLUMNS if column in row), None)
    if column is None:
        raise InvalidRequest(
            "missing_column",
            f"{path} has no column {' or '.join(PATH_COLUMNS)}. Its columns are: {', '.join(row)}. "
            f"A header is, for example, {PHOTO_TABLE_HEADER}; all but the first are optional.",
            missing=[PATH_COLUMNS[0]],
        )
    return column


def _row(path: Path, line: int, row: dict[str, str], root: Path, path_column: str) -> DatasetPhoto:
    """Read a row of a CSV list; empty cells are unknown values, other columns are ignored."""
    name = row[path_column].strip()
    if not name:
        raise bad_row_error(path, line, f"its {path_column} is empty")
    values = {
        COLUMN_ALIASES.get(column, column): cell for column, cell in row.items() if cell.strip()
    }
    numbers = {
        column: parse_number(path, line, values, column)
        for column in NUMBER_COLUMNS
        if column in values
    }
    for first, second in (("latitude", "longitude"), ("easting", "northing")):
        if (first in numbers) != (second in numbers):
            raise bad_row_error(path, line, f"{first} and {second} must be given together")
    named = _photo_of_name(root, name)
    location = named if not numbers.keys() & {"latitude", "easting"} else None
    return DatasetPhoto(
        named.path,
        name,
        easting=numbers.get("easting", location.easting if location else None),
        northing=numbers.get("northing", location.northing if location else None),
        zone=values.get("zone", location.zone if location else None),
        latitude=numbers.get("latitude", location.latitude if location else None),
        longitude=numbers.get("longitude", location.longitude if location else None),
        heading=numbers["heading"] % 360 if "heading" in numbers else named.heading,
        place=values.get("place"),
        frame=parse_integer(path, line, values, "frame") if "frame" in values else named.frame,
        sequence=values.get("sequence"),
    )
