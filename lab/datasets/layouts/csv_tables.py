"""CSV layout for your own photos: `database.csv` and `queries.csv`, and `train.csv` for training.

Columns: `path`, relative to the tables' folder, or else to `database/` and `queries/` there;
`latitude`, `longitude` or `easting`, `northing`, `zone`; `heading`, `place`, `frame`, `sequence`.
All but `path` are optional; `train.csv` needs a `place` in each row, and may have a `city`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lab.datasets.dataset import DatasetPhoto, TrainingSet
from lab.datasets.layouts.base import (
    DEFAULT_RULE,
    PLACEWISE_PROTOCOL,
    CityPhotos,
    ListedSet,
    number_places,
    select_cities,
)
from lab.datasets.photo_lists import bad_row_error, read_photo_list, read_table


class CsvTables:
    """Evaluation sets as CSV tables."""

    name = "CSV tables"
    protocols = (PLACEWISE_PROTOCOL,)

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        exists = all((base / name).is_file() for name in ("database.csv", "queries.csv"))
        return {prefix: "."} if exists else {}

    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        database, queries = _read_photos(base, "database"), _read_photos(base, "queries")
        has_positions = any(photo.easting is not None for photo in database + queries)
        has_labels = any(photo.place for photo in database + queries)
        return ListedSet(
            database, queries, "place-label" if has_labels and not has_positions else DEFAULT_RULE
        )


def _read_photos(base: Path, role: str) -> tuple[DatasetPhoto, ...]:
    table = base / f"{role}.csv"
    beside = read_photo_list(table)
    is_inside = not beside[0].path.exists() and (base / role).is_dir()
    return read_photo_list(table, base / role) if is_inside else beside


class CsvTrainingTable:
    """Training sets as a CSV table."""

    name = "CSV table of places"

    def recognises(self, base: Path) -> bool:
        return (base / "train.csv").is_file()

    def cities(self, base: Path) -> tuple[str, ...]:
        return tuple(sorted(_by_city(base)))

    def open(self, base: Path, cities: Sequence[str] | None, min_photos: int) -> TrainingSet:
        by_city = _by_city(base)
        chosen = select_cities(base, cities, sorted(by_city))
        places = number_places(
            [(city, _number_labels(by_city[city])) for city in chosen], min_photos
        )
        return TrainingSet(base.resolve().name, base, self.name, places)


def _by_city(base: Path) -> dict[str, dict[str, list[Path]]]:
    """Group photos by city and place label; without a column `city` there is one city."""
    table = base / "train.csv"
    by_city: dict[str, dict[str, list[Path]]] = {}
    for line, row in read_table(table, ("path", "place")):
        if not (row["path"].strip() and row["place"].strip()):
            raise bad_row_error(table, line, "path and place are required")
        city = row.get("city", "").strip() or base.resolve().name
        photos = by_city.setdefault(city, {}).setdefault(row["place"].strip(), [])
        photos.append(base / row["path"].strip())
    return by_city


def _number_labels(labels: Mapping[str, list[Path]]) -> CityPhotos:
    """Number the places of a city by the rank of their labels."""
    return {number: labels[label] for number, label in enumerate(sorted(labels))}
