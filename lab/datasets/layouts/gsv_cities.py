"""Training layouts GSV-Cities and gsv_xs.

GSV-Cities: `Dataframes/CITY.csv` and `Images/CITY/*.jpg`. A photo's file name follows from its row:
CITY_PLACE_YEAR_MONTH_NORTHDEG_LAT_LON_PANOID.jpg. gsv-cities-light is the same with fewer and
smaller photos. (github.com/amaralibey/gsv-cities, OpenVPRLab)

gsv_xs: `train/CITY/*.jpg` with `@UTM@` names, and optionally `dataframes/CITY.csv`. Without a table
the place id is in the file names: `4257` in the note `4257_Bangkok`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lab.datasets.dataset import TrainingSet
from lab.datasets.layouts.base import CityPhotos, number_places, photos_below, select_cities
from lab.datasets.photo_lists import parse_integer, read_table
from shared.errors import InvalidRequest
from shared.utm_filenames import parse_utm_file_name

GSV_CITIES_COLUMNS = ("place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid")
# Fields by which a row is matched to its file. Latitude and longitude are excluded, because their
# digits depend on the library that wrote them.
PhotoKey = tuple[int, int, int, int, str]


class GsvCities:
    """Training sets in the layout of GSV-Cities."""

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
    """Return the photos of a folder by key; empty if the folder does not exist."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return {key: path for path in paths if (key := _key_of(path.name)) is not None}


def _key_of(name: str) -> PhotoKey | None:
    """Parse the key of a file name, or return None; panorama ids may contain underscores."""
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
    """Training sets in the layout of gsv_xs."""

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
    evaluation_folders = {"database", "queries"}
    return tuple(
        sorted(
            path.name
            for path in train.iterdir()
            if path.is_dir()
            and path.name not in evaluation_folders
            and not path.name.startswith(".")
        )
    )


def _first_photo(base: Path, city: str) -> list[Path]:
    """Return one photo of the folder, to detect the naming, or an empty list."""
    candidates = (p for p in (base / "train" / city).iterdir() if p.name.startswith("@"))
    first = next(candidates, None)
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
                f"{path} has no place id: its note, the last field, must be PLACE_CITY such as "
                f"4257_Bangkok. Alternatively, add the table {table}.",
            )
        photos.setdefault(place_or_none, []).append(path)
    return photos


def _place_of(name: str) -> int | None:
    location = parse_utm_file_name(name)
    number = location.note.partition("_")[0] if location else ""
    return int(number) if number.isdecimal() and number.isascii() else None
