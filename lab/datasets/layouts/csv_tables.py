"""CSV layout for your own photos: `database.csv` and `queries.csv`, and `train.csv` for training.

Columns: `path`, relative to the tables' folder, or else to `database/` and `queries/` there;
`latitude`, `longitude` or `easting`, `northing`, `zone`; `heading`, `place`, `frame`, `sequence`.
All but `path` are optional; `train.csv` needs a `place` in each row, and may have a `city`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lab.datasets.dataset import DatasetPhoto
from lab.datasets.layouts.base import (
    DEFAULT_RULE,
    CityPhotos,
    EvaluationLayout,
    ListedSet,
    TrainingLayout,
)
from lab.datasets.photo_lists import TableRow, read_photo_list, read_table


class CsvTables(EvaluationLayout):
    """Evaluation sets as CSV tables."""

    name = "CSV tables"

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


class _PlaceRow(TableRow):
    path: str
    place: str
    city: str | None = None


class CsvTrainingTable(TrainingLayout):
    """Training sets as a CSV table; without a column `city` there is one city."""

    name = "CSV table of places"

    def recognises(self, base: Path) -> bool:
        return (base / "train.csv").is_file()

    def cities(self, base: Path) -> tuple[str, ...]:
        rows = read_table(base / "train.csv", _PlaceRow)
        return tuple(sorted({row.city or base.resolve().name for _, row in rows}))

    def photos(self, base: Path, cities: Sequence[str]) -> dict[str, CityPhotos]:
        """Place ids are the ranks of their labels."""
        labels: dict[str, dict[str, list[Path]]] = {city: {} for city in cities}
        for _, row in read_table(base / "train.csv", _PlaceRow):
            city = labels.get(row.city or base.resolve().name)
            if city is not None:
                city.setdefault(row.place, []).append(base / row.path)
        return {
            city: dict(enumerate(places[label] for label in sorted(places)))
            for city, places in labels.items()
        }
