"""Mapillary Street-level Sequences: `train_val/CITY/{query,database}/` with their tables.

Its validation cities are evaluated by two protocols, whose results differ by percentage points:

- `msls-official`: both cities pooled, no panoramas, photos of the subtask `all`, metres of
  `postprocessed.csv`, queries without a positive within 25 m excluded. On the published dataset
  that is 740 queries and 18,871 database photos. (github.com/mapillary/mapillary_sls)
- `vme`: all photos but panoramas, metres computed from latitude and longitude and truncated to
  centimetres, and all queries. (VPR-datasets-downloader, VPR-methods-evaluation)
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import utm

from lab.datasets.dataset import DatasetPhoto
from lab.datasets.layouts.base import DEFAULT_RULE, ListedSet, city_missing_error
from lab.datasets.photo_lists import bad_row_error, parse_integer, parse_number, read_table
from shared.errors import InvalidRequest

OFFICIAL_PROTOCOL = "msls-official"
VME_PROTOCOL = "vme"
VALIDATION_CITIES = ("cph", "sf")
"""Validation cities, in the order in which both protocols pool them"""
VALIDATION_SET = "msls_val"
Row = tuple[int, dict[str, str]]


class Msls:
    """The validation set of MSLS."""

    name = "Mapillary Street-level Sequences"
    protocols = (OFFICIAL_PROTOCOL, VME_PROTOCOL)

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        for key in (".", "train_val"):
            if any(
                (base / key / city / "query" / "raw.csv").is_file() for city in VALIDATION_CITIES
            ):
                return {VALIDATION_SET: key}
        return {}

    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        folder = base / key
        missing = [city for city in VALIDATION_CITIES if not (folder / city).is_dir()]
        if missing:
            available = sorted(path.name for path in folder.iterdir() if path.is_dir())
            raise city_missing_error(folder, missing, available)
        database, queries = (
            tuple(
                photo
                for city in VALIDATION_CITIES
                for photo in _read_photos(base, folder / city / part, protocol)
            )
            for part in ("database", "query")
        )
        return ListedSet(
            database, queries, DEFAULT_RULE, drops_queries=protocol == OFFICIAL_PROTOCOL
        )


def _read_photos(base: Path, folder: Path, protocol: str) -> Iterator[DatasetPhoto]:
    raw = folder / "raw.csv"
    rows = list(read_table(raw, ("key", "lon", "lat", "ca", "pano")))
    companions: dict[str, tuple[str, ...]] = {
        "postprocessed.csv": ("key", "easting", "northing"),
        "seq_info.csv": ("key", "sequence_key", "frame_number"),
    }
    if protocol == OFFICIAL_PROTOCOL:
        companions["subtask_index.csv"] = ("all",)
    tables = {
        name: _read_aligned_table(folder / name, needed, rows)
        for name, needed in companions.items()
    }
    zone = _zone(raw, rows[0]) if rows else ""
    for index, (line, row) in enumerate(rows):
        if _parse_boolean(raw, line, row, "pano"):
            continue
        if protocol == OFFICIAL_PROTOCOL:
            table = folder / "subtask_index.csv"
            if not _parse_boolean(table, *tables[table.name][index], "all"):
                continue
        yield _read_photo(
            base, folder, (line, row), {k: v[index] for k, v in tables.items()}, protocol, zone
        )


def _read_photo(
    base: Path, folder: Path, raw: Row, companions: Mapping[str, Row], protocol: str, zone: str
) -> DatasetPhoto:
    table = folder / "raw.csv"
    latitude, longitude = parse_number(table, *raw, "lat"), parse_number(table, *raw, "lon")
    if protocol == OFFICIAL_PROTOCOL:
        metres = folder / "postprocessed.csv"
        easting, northing = (
            parse_number(metres, *companions[metres.name], column)
            for column in ("easting", "northing")
        )
        photo_zone: str | None = zone
    else:
        easting, northing = (_truncate(value) for value in utm.from_latlon(latitude, longitude)[:2])
        photo_zone = None
    path = folder / "images" / f"{raw[1]['key']}.jpg"
    sequence = folder / "seq_info.csv"
    return DatasetPhoto(
        path,
        path.relative_to(base).as_posix(),
        easting=easting,
        northing=northing,
        zone=photo_zone,
        latitude=latitude,
        longitude=longitude,
        heading=parse_number(table, *raw, "ca") % 360 if raw[1]["ca"] else None,
        frame=parse_integer(sequence, *companions[sequence.name], "frame_number"),
        sequence=companions[sequence.name][1]["sequence_key"],
    )


def _read_aligned_table(path: Path, needed: tuple[str, ...], rows: list[Row]) -> list[Row]:
    """Read a table whose rows correspond one by one to those of raw.csv."""
    table = list(read_table(path, needed))
    if len(table) != len(rows):
        raise InvalidRequest(
            "bad_table",
            f"{path} has {len(table)} rows, but raw.csv has {len(rows)}: they are of different "
            "versions of the dataset.",
        )
    for (line, row), (_, other) in zip(table, rows, strict=True):
        if "key" in row and row["key"] != other["key"]:
            raise bad_row_error(
                path, line, f"its photo is {row['key']}, but that of raw.csv is {other['key']}"
            )
    return table


def _parse_boolean(path: Path, line: int, row: dict[str, str], column: str) -> bool:
    values = {"true": True, "false": False, "1": True, "0": False}
    try:
        return values[row[column].lower()]
    except KeyError:
        raise bad_row_error(
            path, line, f"{column} {row[column]!r} is neither True nor False"
        ) from None


def _zone(path: Path, first: Row) -> str:
    """Return the UTM zone of a city: that of its first photo."""
    latitude, longitude = parse_number(path, *first, "lat"), parse_number(path, *first, "lon")
    zone = utm.latlon_to_zone_number(latitude, longitude)
    return f"{zone:02d}{utm.latitude_to_zone_letter(latitude)}"


def _truncate(metres: float) -> float:
    return math.floor(float(metres) * 100) / 100
