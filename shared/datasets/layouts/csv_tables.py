"""One's own photos, listed in CSV: `database.csv` and `queries.csv`, and `train.csv` to learn from.

Columns: `path`, beginning at the tables' folder; `latitude`, `longitude` or `easting`, `northing`,
`zone`; `heading`, `place`, `frame`, `sequence`. All but the path may be left out; `train.csv` needs
a `place` in each row, and may have a `city`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from shared.datasets.dataset import TrainingSet
from shared.datasets.layouts.base import (
    DEFAULT_RULE,
    PLACEWISE_PROTOCOL,
    CityPhotos,
    ListedSet,
    number_places,
    select_cities,
)
from shared.datasets.photo_lists import bad_row_error, read_photo_list, read_table


class CsvTables:
    name = "CSV tables"
    protocols = (PLACEWISE_PROTOCOL,)

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        there = all((base / name).is_file() for name in ("database.csv", "queries.csv"))
        return {prefix: "."} if there else {}

    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        database, queries = (
            read_photo_list(base / "database.csv"),
            read_photo_list(base / "queries.csv"),
        )
        placed = any(shot.easting is not None for shot in database + queries)
        labelled = any(shot.place for shot in database + queries)
        return ListedSet(
            database, queries, "place-label" if labelled and not placed else DEFAULT_RULE
        )


class CsvTrainingTable:
    name = "CSV table of places"

    def recognises(self, base: Path) -> bool:
        return (base / "train.csv").is_file()

    def cities(self, base: Path) -> tuple[str, ...]:
        return tuple(sorted(_by_city(base)))

    def open(self, base: Path, cities: Sequence[str] | None, min_photos: int) -> TrainingSet:
        by_city = _by_city(base)
        chosen = select_cities(base, cities, sorted(by_city))
        places = number_places([(city, _numbers(by_city[city])) for city in chosen], min_photos)
        return TrainingSet(base.resolve().name, base, self.name, places)


def _by_city(base: Path) -> dict[str, dict[str, list[Path]]]:
    """The photos of each label of each city; without a column `city` all are of one."""
    table = base / "train.csv"
    found: dict[str, dict[str, list[Path]]] = {}
    for line, row in read_table(table, ("path", "place")):
        if not (row["path"].strip() and row["place"].strip()):
            raise bad_row_error(table, line, "path and place must be given")
        city = row.get("city", "").strip() or base.resolve().name
        photos = found.setdefault(city, {}).setdefault(row["place"].strip(), [])
        photos.append(base / row["path"].strip())
    return found


def _numbers(labels: Mapping[str, list[Path]]) -> CityPhotos:
    """Places by number: a label's rank among the city's."""
    return {number: labels[label] for number, label in enumerate(sorted(labels))}
