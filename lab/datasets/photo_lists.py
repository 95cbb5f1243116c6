"""Photo lists: CSV with positions, `.npy` arrays of paths, text files with one path per line.

Also reads positions from `@UTM@` file names and EXIF, and rows of CSV tables, with errors that name
file and line.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Self, TypeVar

from pydantic import (
    AliasChoices,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    model_validator,
)

from lab.datasets.dataset import PHOTO_TABLE_HEADER, DatasetPhoto
from lab.datasets.ground_truth_files import read_names
from lab.datasets.utm_coordinates import add_utm_positions
from lab.datasets.utm_names import parse_utm_file_name
from shared.errors import InvalidRequest, PlacewiseError, Unprocessable
from shared.imaging.photo_header import read_photo_header

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


def photos_of_names(folder: Path, names: Iterable[str]) -> tuple[DatasetPhoto, ...]:
    """Create the photos of a list; names are relative to the folder, also with a leading slash."""
    return tuple(photo_from_filename(folder / name.lstrip("/"), name) for name in names)


def locate_photos(photos: Iterable[DatasetPhoto]) -> tuple[DatasetPhoto, ...]:
    """Add UTM metres to photos without any, from latitude and longitude or from EXIF.

    Photos without EXIF, and unreadable ones, are returned unchanged.
    """
    located = add_utm_positions(photos)
    return add_utm_positions(
        photo if photo.easting is not None else _add_exif_position(photo) for photo in located
    )


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


class TableRow(BaseModel):
    """A row of a CSV table; its fields are the columns that are read. An empty cell is no value."""

    model_config = ConfigDict(frozen=True, str_strip_whitespace=True)


Row = TypeVar("Row", bound=TableRow)


def read_table(path: Path, row_type: type[Row]) -> Iterator[tuple[int, Row]]:
    """Yield the line number and the row of each line of a CSV file; other columns are ignored.

    Raises InvalidRequest: `missing_column` (which lists the existing columns), `bad_table`.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            columns = reader.fieldnames or []
            _check_columns(path, row_type, columns)
            for cells in reader:
                if None in cells or None in cells.values():
                    reason = f"it does not have the {len(columns)} cells of the first line"
                    raise bad_row_error(path, reader.line_num, reason)
                try:
                    values = {column: cell for column, cell in cells.items() if cell.strip()}
                    yield reader.line_num, row_type.model_validate(values)
                except ValidationError as error:
                    raise bad_row_error(path, reader.line_num, _reason(error)) from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidRequest("bad_table", f"Can't read {path}: {error}.") from error


def _check_columns(path: Path, row_type: type[Row], columns: Sequence[str]) -> None:
    missing = []
    for name, field in row_type.model_fields.items():
        alias = field.validation_alias
        names = [str(each) for each in alias.choices] if isinstance(alias, AliasChoices) else [name]
        if field.is_required() and not set(names) & set(columns):
            missing.append(" or ".join(names))
    if missing:
        raise InvalidRequest(
            "missing_column",
            f"{path} has no column {', '.join(missing)}. Its first line, separated by commas, is: "
            f"{', '.join(columns) or 'empty'}.",
            missing=missing,
        )


def _reason(error: ValidationError) -> str:
    first = error.errors()[0]
    column = f"{first['loc'][0]} " if first["loc"] else ""
    if first["type"] == "missing":
        return f"{column}is empty"
    value = "" if first["type"] == "value_error" else f"{first['input']!r}: "
    return f"{column}{value}{first['msg'].removeprefix('Value error, ')}"


def bad_row_error(path: Path, line: int, reason: str) -> PlacewiseError:
    """Return the error for a row of a table that can't be used."""
    return InvalidRequest("bad_table", f"{path}, line {line}: {reason}.", line=line)


class PhotoRow(TableRow):
    """A photo of a list."""

    path: Annotated[str, Field(validation_alias=AliasChoices("path", "filename", "file"))]
    latitude: FiniteFloat | None = Field(None, validation_alias=AliasChoices("latitude", "lat"))
    longitude: FiniteFloat | None = Field(None, validation_alias=AliasChoices("longitude", "lon"))
    easting: FiniteFloat | None = Field(None, validation_alias=AliasChoices("easting", "UTMx"))
    northing: FiniteFloat | None = Field(None, validation_alias=AliasChoices("northing", "UTMy"))
    zone: str | None = None
    heading: FiniteFloat | None = None
    place: str | None = None
    frame: int | None = None
    sequence: str | None = None

    @model_validator(mode="after")
    def _check_pairs(self) -> Self:
        for first, second in (("latitude", "longitude"), ("easting", "northing")):
            if (getattr(self, first) is None) != (getattr(self, second) is None):
                raise ValueError(f"{first} and {second} must be given together")
        return self


def read_photo_list(path: Path, folder: Path | None = None) -> tuple[DatasetPhoto, ...]:
    """Read the photos of a list, in its order: `.csv`, `.npy`, or text with a path a line.

    Positions come from the columns of a CSV, from `@UTM@` file names, or from EXIF. Paths are
    relative to `folder`, by default the list's own.

    Raises InvalidRequest: `bad_list`, `bad_table`, `missing_column`, `bad_coordinates`.
    """
    root = path.parent if folder is None else folder
    match path.suffix.lower():
        case ".csv":
            photos = tuple(_photo_of_row(root, row) for _, row in read_table(path, PhotoRow))
        case ".npy":
            photos = photos_of_names(root, read_names(path))
        case _:
            photos = photos_of_names(root, read_lines(path))
    if not photos:
        raise InvalidRequest(
            "bad_list",
            f"{path} lists no photos. The header of a CSV is, for example, {PHOTO_TABLE_HEADER}; "
            "all columns but path are optional.",
        )
    return locate_photos(photos)


def read_lines(path: Path) -> list[str]:
    """Read the lines of a text file that are not empty; raises InvalidRequest (`bad_list`)."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidRequest("bad_list", f"Can't read {path}: {error}.") from error
    return [line.strip() for line in lines if line.strip()]


def _photo_of_row(root: Path, row: PhotoRow) -> DatasetPhoto:
    (named,) = photos_of_names(root, [row.path])
    position = named if row.latitude is None and row.easting is None else row
    return replace(
        named,
        easting=position.easting,
        northing=position.northing,
        zone=row.zone or position.zone,
        latitude=position.latitude,
        longitude=position.longitude,
        heading=named.heading if row.heading is None else row.heading % 360,
        place=row.place,
        frame=named.frame if row.frame is None else row.frame,
        sequence=row.sequence,
    )
