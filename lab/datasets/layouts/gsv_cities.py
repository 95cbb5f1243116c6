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

from lab.datasets.layouts.base import CityPhotos, TrainingLayout, photos_below
from lab.datasets.photo_lists import TableRow, read_table
from lab.datasets.utm_names import parse_utm_file_name
from shared.errors import InvalidRequest


class GsvCities(TrainingLayout):
    """Training sets in the layout of GSV-Cities."""

    name = "GSV-Cities"

    def recognises(self, base: Path) -> bool:
        return (base / "Images").is_dir() and bool(self.cities(base))

    def cities(self, base: Path) -> tuple[str, ...]:
        return tuple(sorted(table.stem for table in (base / "Dataframes").glob("*.csv")))

    def photos(self, base: Path, cities: Sequence[str]) -> dict[str, CityPhotos]:
        return {city: self._city_photos(base, city) for city in cities}

    def _city_photos(self, base: Path, city: str) -> CityPhotos:
        files: dict[str, dict[_PhotoKey, Path]] = {}
        photos: CityPhotos = {}
        for _, row in read_table(base / "Dataframes" / f"{city}.csv", _GsvCitiesRow):
            folder = base / "Images" / row.city_id
            if row.city_id not in files:
                files[row.city_id] = _files(folder)
            path = files[row.city_id].get(row.key()) or folder / row.file_name()
            photos.setdefault(row.place_id, []).append(path)
        return photos


# Fields by which a row is matched to its file. Latitude and longitude are excluded, because their
# digits depend on the library that wrote them.
_PhotoKey = tuple[int, int, int, int, str]


class _GsvCitiesRow(TableRow):
    place_id: int
    year: int
    month: int
    northdeg: int
    city_id: str
    lat: str
    lon: str
    panoid: str

    def key(self) -> _PhotoKey:
        return self.place_id, self.year, self.month, self.northdeg, self.panoid

    def file_name(self) -> str:
        return (
            f"{self.city_id}_{self.place_id:07d}_{self.year:04d}_{self.month:02d}_"
            f"{self.northdeg:03d}_{self.lat}_{self.lon}_{self.panoid}.jpg"
        )


def _files(folder: Path) -> dict[_PhotoKey, Path]:
    """Return the photos of a folder by key; empty if the folder does not exist."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return {key: path for path in paths if (key := _key_of(path.name)) is not None}


def _key_of(name: str) -> _PhotoKey | None:
    """Parse the key of a file name, or return None; panorama ids may contain underscores."""
    fields = name.removesuffix(".jpg").split("_", 7)
    if len(fields) != 8:
        return None
    try:
        place, year, month, heading = map(int, fields[1:5])
    except ValueError:
        return None
    return place, year, month, heading, fields[7]


class _GsvXsRow(TableRow):
    place_id: int
    class_name: str
    filename: str


class GsvXs(TrainingLayout):
    """Training sets in the layout of gsv_xs."""

    name = "gsv_xs"

    def recognises(self, base: Path) -> bool:
        if any((base / "dataframes" / f"{city}.csv").is_file() for city in self.cities(base)):
            return True
        folders = [base / "train" / city for city in self.cities(base)]
        names = (path.name for folder in folders for path in folder.iterdir())
        first = next((name for name in names if name.startswith("@")), None)
        return first is not None and _place_of(first) is not None

    def cities(self, base: Path) -> tuple[str, ...]:
        train = base / "train"
        return tuple(
            sorted(
                path.name
                for path in (train.iterdir() if train.is_dir() else ())
                if path.is_dir()
                and path.name not in ("database", "queries")  # of an evaluation set
                and not path.name.startswith(".")
            )
        )

    def photos(self, base: Path, cities: Sequence[str]) -> dict[str, CityPhotos]:
        return {city: self._city_photos(base, city) for city in cities}

    def _city_photos(self, base: Path, city: str) -> CityPhotos:
        folder, table = base / "train" / city, base / "dataframes" / f"{city}.csv"
        photos: CityPhotos = {}
        if table.is_file():
            for _, row in read_table(table, _GsvXsRow):
                photos.setdefault(row.place_id, []).append(folder / row.filename)
            return photos
        for path in photos_below(folder):
            place = _place_of(path.name)
            if place is None:
                raise InvalidRequest(
                    "no_place_in_name",
                    f"{path} has no place id: its note, the last field, must be PLACE_CITY such as "
                    f"4257_Bangkok. Alternatively, add the table {table}.",
                )
            photos.setdefault(place, []).append(path)
        return photos


def _place_of(name: str) -> int | None:
    location = parse_utm_file_name(name)
    number = location.note.partition("_")[0] if location else ""
    return int(number) if number.isdecimal() and number.isascii() else None
