"""Lists of photos: a `.npy` of paths, a CSV with a position a row, or one path a line.

Photos on disk as shots: by their file names, and by EXIF where names say nothing.

CSV tables of data sets: by their columns' names, with errors that name file and line.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from shared.datasets.dataset import DatasetPhoto
from shared.datasets.ground_truth_files import read_names
from shared.datasets.utm_coordinates import add_utm_positions
from shared.datasets.utm_filenames import parse_utm_file_name
from shared.errors import InvalidRequest, PlacewiseError, Unprocessable
from shared.imaging.photo_header import read_photo_header

UNLIMITED_PIXELS = 2**62  # of pixels: only the header is read here


def photo_from_filename(path: Path, name: str, place: str | None = None) -> DatasetPhoto:
    """By an `@UTM@` file name; a photo of another name has no position.

    Raises InvalidRequest (`bad_coordinates`).
    """
    spot = parse_utm_file_name(path.name)
    if spot is None:
        return DatasetPhoto(path, name, place=place)
    return DatasetPhoto(
        path,
        name,
        easting=spot.east,
        northing=spot.north,
        zone=spot.zone,
        latitude=spot.latitude,
        longitude=spot.longitude,
        heading=spot.heading,
        place=place,
    )


def add_exif_positions(
    shots: Iterable[DatasetPhoto], done: Callable[[int], None] = lambda count: None
) -> list[DatasetPhoto]:
    """The shots, those without a position with what EXIF says; a photo that has none, or that can't
    be read, stays without."""
    located = []
    for shot in shots:
        located.append(shot if shot.easting is not None else _add_exif_position(shot))
        done(1)
    return located


def _add_exif_position(shot: DatasetPhoto) -> DatasetPhoto:
    try:
        with shot.path.open("rb") as file:
            header = read_photo_header(file, UNLIMITED_PIXELS)
    except (OSError, Unprocessable):
        # Whoever decodes it says so; here it is a photo of which nothing is known.
        return shot
    return DatasetPhoto(
        shot.path,
        shot.name,
        latitude=header.latitude,
        longitude=header.longitude,
        heading=header.heading,
        place=shot.place,
        frame=shot.frame,
        sequence=shot.sequence,
    )


def read_table(path: Path, needed: Sequence[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Each row, by column, with its line in the file; further columns are there too.

    Raises InvalidRequest (`missing_column`, which names those that are there; `bad_table`).
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            columns = reader.fieldnames or []
            missing = [column for column in needed if column not in columns]
            if missing:
                raise InvalidRequest(
                    "missing_column",
                    f"{path} has no column {', '.join(missing)}. Its first line, read as separated "
                    f"by commas, is: {', '.join(columns) or 'empty'}.",
                    missing=missing,
                )
            for row in reader:
                line = reader.line_num
                if None in row or None in row.values():
                    raise bad_row_error(
                        path, line, f"has not the {len(columns)} cells of the first line"
                    )
                yield line, row
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidRequest("bad_table", f"Can't read {path}: {error}.") from error


def parse_integer(path: Path, line: int, row: dict[str, str], column: str) -> int:
    """A cell as an integer; `7.0`, as data frames write it, is 7."""
    value = parse_number(path, line, row, column)
    if value != int(value):
        raise bad_row_error(path, line, f"{column} {row[column]!r} is no whole number")
    return int(value)


def parse_number(path: Path, line: int, row: dict[str, str], column: str) -> float:
    try:
        value = float(row[column])
        if abs(value) < float("inf"):
            return value
    except ValueError:
        pass
    raise bad_row_error(path, line, f"{column} {row[column]!r} is no number")


def bad_row_error(path: Path, line: int, fault: str) -> PlacewiseError:
    return InvalidRequest("bad_table", f"{path}, line {line}: {fault}.", line=line)


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
