"""GSV-Cities as it was published: `Dataframes/CITY.csv` and `Images/CITY/*.jpg`.

A photo's name follows from its row: CITY_PLACE_YEAR_MONTH_NORTHDEG_LAT_LON_PANOID.jpg. gsv-cities-
light is the same with fewer and smaller photos. (github.com/amaralibey/gsv-cities, OpenVPRLab)

gsv_xs: `train/CITY/*.jpg` with `@` names, and `dataframes/CITY.csv` where somebody made it.

Without a table the place stands in the names: `4257` of the note `4257_Bangkok`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from shared.datasets.dataset import TrainingSet
from shared.datasets.layouts.base import CityPhotos, number_places, photos_below, select_cities
from shared.datasets.photo_lists import parse_integer, read_table
from shared.datasets.utm_filenames import parse_utm_file_name
from shared.errors import InvalidRequest

GSV_CITIES_COLUMNS = ("place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid")
# A photo's row and its file agree in these; latitude and longitude are left out, because their
# digits depend on the library that wrote them.
PhotoKey = tuple[int, int, int, int, str]


class GsvCities:
    name = "GSV-Cities"

    def recognises(self, base: Path) -> bool:
        return (base / "Images").is_dir() and bool(self.cities(base))

    def cities(self, base: Path) -> tuple[str, ...]:
        return tuple(sorted(table.stem for table in (base / "Dataframes").glob("*.csv")))

    def open(self, base: Path, cities: Sequence[str] | None, min_photos: int) -> TrainingSet:
        chosen = select_cities(base, cities, self.cities(base))
        places = number_places([(city, _photos(base, city)) for city in chosen], min_photos)
        return TrainingSet(base.resolve().name, base, self.name, places)


def _photos(base: Path, city: str) -> CityPhotos:
    table = base / "Dataframes" / f"{city}.csv"
    files: dict[str, dict[PhotoKey, Path]] = {}
    photos: CityPhotos = {}
    for line, row in read_table(table, GSV_CITIES_COLUMNS):
        place, year, month, heading = (
            parse_integer(table, line, row, column)
            for column in ("place_id", "year", "month", "northdeg")
        )
        key: PhotoKey = (place, year, month, heading, row["panoid"])
        folder = base / "Images" / row["city_id"]
        if row["city_id"] not in files:
            files[row["city_id"]] = _files(folder)
        path = files[row["city_id"]].get(key) or folder / _file_name(row, key)
        photos.setdefault(place, []).append(path)
    return photos


def _files(folder: Path) -> dict[PhotoKey, Path]:
    """The photos of the folder by what their rows say of them; none where there is no folder."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return {key: path for path in paths if (key := _key_of(path.name)) is not None}


def _key_of(name: str) -> PhotoKey | None:
    """None for a file that is no photo of this layout. A panorama's name may hold underscores."""
    fields = name.removesuffix(".jpg").split("_", 7)
    if len(fields) != 8:
        return None
    try:
        place, year, month, heading = map(int, fields[1:5])
    except ValueError:
        return None
    return place, year, month, heading, fields[7]


def _file_name(row: dict[str, str], key: PhotoKey) -> str:
    place, year, month, heading, panoid = key
    return (
        f"{row['city_id']}_{place:07d}_{year:04d}_{month:02d}_{heading:03d}_"
        f"{row['lat']}_{row['lon']}_{panoid}.jpg"
    )


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
        places = number_places(
            [(city, _photos_of_gsv_xs(base, city)) for city in chosen], min_photos
        )
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


def _photos_of_gsv_xs(base: Path, city: str) -> CityPhotos:
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
