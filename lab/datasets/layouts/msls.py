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
from pydantic import FiniteFloat

from lab.datasets.dataset import DatasetPhoto
from lab.datasets.layouts.base import EvaluationLayout, ListedSet, city_missing_error
from lab.datasets.photo_lists import Row, TableRow, bad_row_error, read_table
from shared.errors import InvalidRequest

OFFICIAL_PROTOCOL = "msls-official"
VME_PROTOCOL = "vme"
VALIDATION_CITIES = ("cph", "sf")
"""Validation cities, in the order in which both protocols pool them"""
VALIDATION_SET = "msls_val"


class Msls(EvaluationLayout):
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
        return ListedSet(database, queries, drops_queries=protocol == OFFICIAL_PROTOCOL)


class _RawRow(TableRow):
    key: str
    lon: FiniteFloat
    lat: FiniteFloat
    ca: FiniteFloat | None = None
    pano: bool


class _SequenceRow(TableRow):
    key: str
    sequence_key: str
    frame_number: int


class _MetresRow(TableRow):
    key: str
    easting: FiniteFloat
    northing: FiniteFloat


class _SubtaskRow(TableRow):
    all: bool


def _read_photos(base: Path, folder: Path, protocol: str) -> Iterator[DatasetPhoto]:
    photos = [row for _, row in read_table(folder / "raw.csv", _RawRow)]
    sequences = _read_aligned_table(folder / "seq_info.csv", _SequenceRow, photos)
    if protocol == OFFICIAL_PROTOCOL:
        positions = _read_aligned_table(folder / "postprocessed.csv", _MetresRow, photos)
        subtasks = _read_aligned_table(folder / "subtask_index.csv", _SubtaskRow, photos)
    for index, photo in enumerate(photos):
        if photo.pano:
            continue
        if protocol == OFFICIAL_PROTOCOL:
            if not subtasks[index].all:
                continue
            easting, northing = positions[index].easting, positions[index].northing
            # The metres of a city are those of its first photo's zone.
            number = utm.latlon_to_zone_number(photos[0].lat, photos[0].lon)
            zone = f"{number:02d}{utm.latitude_to_zone_letter(photos[0].lat)}"
        else:
            easting, northing = map(_truncate, utm.from_latlon(photo.lat, photo.lon)[:2])
            zone = None
        path = folder / "images" / f"{photo.key}.jpg"
        yield DatasetPhoto(
            path,
            path.relative_to(base).as_posix(),
            easting=easting,
            northing=northing,
            zone=zone,
            latitude=photo.lat,
            longitude=photo.lon,
            heading=None if photo.ca is None else photo.ca % 360,
            frame=sequences[index].frame_number,
            sequence=sequences[index].sequence_key,
        )


def _truncate(metres: float) -> float:
    return math.floor(float(metres) * 100) / 100


def _read_aligned_table(path: Path, row_type: type[Row], photos: list[_RawRow]) -> list[Row]:
    """Read a table whose rows correspond one by one to those of raw.csv."""
    table = list(read_table(path, row_type))
    if len(table) != len(photos):
        raise InvalidRequest(
            "bad_table",
            f"{path} has {len(table)} rows, but raw.csv has {len(photos)}: they are of different "
            "versions of the dataset.",
        )
    for (line, row), photo in zip(table, photos, strict=True):
        key = getattr(row, "key", photo.key)
        if key != photo.key:
            raise bad_row_error(
                path, line, f"its photo is {key}, but that of raw.csv is {photo.key}"
            )
    return [row for _, row in table]
