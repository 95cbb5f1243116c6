"""GSV-Cities as it was published: `Dataframes/CITY.csv` and `Images/CITY/*.jpg`.

A photo's name follows from its row: CITY_PLACE_YEAR_MONTH_NORTHDEG_LAT_LON_PANOID.jpg. gsv-cities-
light is the same with fewer and smaller photos. (github.com/amaralibey/gsv-cities, OpenVPRLab)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from shared.datasets.layouts.cities import CityPhotos, number_places, select_cities
from shared.datasets.layouts.tables import parse_integer, read_table
from shared.datasets.shots import TrainingSet

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
