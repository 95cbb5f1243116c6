"""gsv_xs: `train/CITY/*.jpg` with `@` names, and `dataframes/CITY.csv` where somebody made it.

Without a table the place stands in the names: `4257` of the note `4257_Bangkok`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from shared.datasets.layouts.cities import CityPhotos, number_places, select_cities
from shared.datasets.layouts.layout import photos_below
from shared.datasets.layouts.tables import parse_integer, read_table
from shared.datasets.shots import TrainingSet
from shared.datasets.utm_names import parse_utm_file_name
from shared.errors import InvalidRequest

GSV_XS_COLUMNS = ("place_id", "class_name", "filename")


class GsvXs:
    name = "gsv_xs"

    def recognises(self, base: Path) -> bool:
        if any((base / "dataframes" / f"{city}.csv").is_file() for city in _folders(base)):
            return True
        first = next((path for city in _folders(base) for path in _first_photo(base, city)), None)
        return first is not None and _place_of(first.name) is not None

    def cities(self, base: Path) -> tuple[str, ...]:
        return _folders(base)

    def open(self, base: Path, cities: Sequence[str] | None, min_photos: int) -> TrainingSet:
        chosen = select_cities(base, cities, self.cities(base))
        places = number_places([(city, _photos(base, city)) for city in chosen], min_photos)
        return TrainingSet(base.resolve().name, base, self.name, places)


def _folders(base: Path) -> tuple[str, ...]:
    train = base / "train"
    if not train.is_dir():
        return ()
    hidden_or_pair = {"database", "queries"}
    return tuple(
        sorted(
            path.name
            for path in train.iterdir()
            if path.is_dir() and path.name not in hidden_or_pair and not path.name.startswith(".")
        )
    )


def _first_photo(base: Path, city: str) -> list[Path]:
    """The first photo that the folder gives, of which one is enough to see how all are named."""
    found = (p for p in (base / "train" / city).iterdir() if p.name.startswith("@"))
    first = next(found, None)
    return [] if first is None else [first]


def _photos(base: Path, city: str) -> CityPhotos:
    folder = base / "train" / city
    table = base / "dataframes" / f"{city}.csv"
    photos: CityPhotos = {}
    if table.is_file():
        for line, row in read_table(table, GSV_XS_COLUMNS):
            place = parse_integer(table, line, row, "place_id")
            photos.setdefault(place, []).append(folder / row["filename"])
        return photos
    for path in photos_below(folder):
        place_or_none = _place_of(path.name)
        if place_or_none is None:
            raise InvalidRequest(
                "no_place_in_name",
                f"{path} says no place: its note, the last field, has to be PLACE_CITY such as "
                f"4257_Bangkok. A table {table} may say it instead.",
            )
        photos.setdefault(place_or_none, []).append(path)
    return photos


def _place_of(name: str) -> int | None:
    spot = parse_utm_file_name(name)
    number = spot.note.partition("_")[0] if spot else ""
    return int(number) if number.isdecimal() and number.isascii() else None
