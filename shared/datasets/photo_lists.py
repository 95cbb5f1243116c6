"""Lists of photos: a `.npy` of paths, a CSV with a position a row, or one path a line."""

from __future__ import annotations

from pathlib import Path

from shared.datasets.integer_lists import read_names
from shared.datasets.layouts.named_photos import add_exif_positions, photo_from_filename
from shared.datasets.layouts.tables import bad_row_error, parse_integer, parse_number, read_table
from shared.datasets.shots import DatasetPhoto
from shared.datasets.zones import add_utm_positions
from shared.errors import InvalidRequest

PATH_COLUMNS = ("path", "filename", "file")
COLUMN_ALIASES = {"lat": "latitude", "lon": "longitude", "UTMx": "easting", "UTMy": "northing"}
"""columns by the names that other data sets give them"""
NUMBER_COLUMNS = ("latitude", "longitude", "easting", "northing", "heading")
TEXT_COLUMNS = ("zone", "place", "sequence")


def read_photo_list(path: Path, folder: Path | None = None) -> tuple[DatasetPhoto, ...]:
    """The photos in the list's order, whose paths begin at `folder` (left out: the list's own).

    Their positions stand in a CSV's columns, in `@UTM@` file names, or in the EXIF of those that
    are there. Raises InvalidRequest (`bad_list`, `bad_table`, `missing_column`, `bad_coordinates`).
    """
    root = path.parent if folder is None else folder
    match path.suffix.lower():
        case ".csv":
            shots = [
                _row(path, line, row, root, _path_column(path, row))
                for line, row in read_table(path, ())
            ]
        case ".npy":
            shots = [_named(root, name) for name in read_names(path)]
        case _:
            shots = [_named(root, name) for name in _lines(path)]
    if not shots:
        raise InvalidRequest("bad_list", f"{path} names no photo.")
    return add_utm_positions(add_exif_positions(add_utm_positions(shots)))


def _named(root: Path, name: str) -> DatasetPhoto:
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
            f"{path} has no column {' or '.join(PATH_COLUMNS)}. Its columns are: {', '.join(row)}.",
            missing=[PATH_COLUMNS[0]],
        )
    return column


def _row(path: Path, line: int, row: dict[str, str], root: Path, path_column: str) -> DatasetPhoto:
    """Empty cells are not said; further columns are the set's own business."""
    name = row[path_column].strip()
    if not name:
        raise bad_row_error(path, line, f"its {path_column} is empty")
    said = {
        COLUMN_ALIASES.get(column, column): cell for column, cell in row.items() if cell.strip()
    }
    numbers = {
        column: parse_number(path, line, said, column)
        for column in NUMBER_COLUMNS
        if column in said
    }
    for one, other in (("latitude", "longitude"), ("easting", "northing")):
        if (one in numbers) != (other in numbers):
            raise bad_row_error(path, line, f"{one} and {other} come in pairs")
    by_name = _named(root, name)
    placed = by_name if not numbers.keys() & {"latitude", "easting"} else None
    return DatasetPhoto(
        by_name.path,
        name,
        easting=numbers.get("easting", placed.easting if placed else None),
        northing=numbers.get("northing", placed.northing if placed else None),
        zone=said.get("zone", placed.zone if placed else None),
        latitude=numbers.get("latitude", placed.latitude if placed else None),
        longitude=numbers.get("longitude", placed.longitude if placed else None),
        heading=numbers["heading"] % 360 if "heading" in numbers else by_name.heading,
        place=said.get("place"),
        frame=parse_integer(path, line, said, "frame") if "frame" in said else None,
        sequence=said.get("sequence"),
    )
