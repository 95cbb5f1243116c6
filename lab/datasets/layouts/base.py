"""Base classes of dataset layouts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from lab.datasets.dataset import DatasetPhoto, Indices, TrainingPlace, TrainingSet
from shared.errors import NotFound
from shared.imaging.file_formats import PHOTO_SUFFIXES

PLACEWISE_PROTOCOL = "placewise"
"""The default protocol: all photos, all queries, correct across UTM zones"""
DEFAULT_RULE = "radius 25 m"
"""The positive-match criterion of nearly all published results."""
PLACE_ID_STEP = 10**5
"""Offset between the place ids of two cities, as in GSV-Cities"""

CityPhotos = dict[int, list[Path]]
"""The photos of each place of a city, by the city's own place id"""


@dataclass(frozen=True, slots=True)
class ListedSet:
    """An evaluation set as its layout lists it, before positives are computed."""

    database: tuple[DatasetPhoto, ...]
    queries: tuple[DatasetPhoto, ...]
    rule: str = DEFAULT_RULE
    """The default positive-match criterion of the set."""
    positives: Sequence[Indices] | None = None
    """Positives by that rule, if the set includes a ground truth."""
    drops_queries: bool = False
    """Whether the protocol excludes queries without positives."""
    paired_by: str | None = None
    """What numbers the photos of two seasons, in words; None for other sets"""


class EvaluationLayout(ABC):
    """A layout of evaluation sets."""

    name: ClassVar[str]
    protocols: ClassVar[tuple[str, ...]] = (PLACEWISE_PROTOCOL,)
    """Names of the protocols; the first is the default."""

    @abstractmethod
    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        """Return the key for `open` by the name of each set in `base`; {} for other layouts.

        `prefix` is the first part of generated names.
        """

    @abstractmethod
    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        """Read the photos of a set."""


class TrainingLayout(ABC):
    """A layout of training sets. `base` is a folder for which `recognises` is true."""

    name: ClassVar[str]

    @abstractmethod
    def recognises(self, base: Path) -> bool:
        """Whether the folder has this layout."""

    @abstractmethod
    def cities(self, base: Path) -> tuple[str, ...]:
        """Return the names of the cities, sorted."""

    @abstractmethod
    def photos(self, base: Path, cities: Sequence[str]) -> dict[str, CityPhotos]:
        """Read the photos of each of these cities, in their order."""

    def open(self, base: Path, cities: Sequence[str] | None, min_photos: int) -> TrainingSet:
        """Open the places with at least `min_photos` photos of the given cities, or of all.

        They are sorted by city, in the given order, and by id. Raises NotFound (`city_missing`).
        """
        available = self.cities(base)
        known = {city.lower(): city for city in available}
        missing = [city for city in cities or () if city.lower() not in known]
        if missing:
            raise city_missing_error(base, missing, available)
        chosen = available if cities is None else [known[city.lower()] for city in cities]
        photos = self.photos(base, list(dict.fromkeys(chosen)))
        largest = max((max(places, default=0) for places in photos.values()), default=0)
        step = max(PLACE_ID_STEP, 10 ** len(str(largest)))
        places = tuple(
            TrainingPlace(place + index * step, city, tuple(city_photos[place]))
            for index, (city, city_photos) in enumerate(photos.items())
            for place in sorted(city_photos)
            if len(city_photos[place]) >= min_photos
        )
        return TrainingSet(base.resolve().name, base, self.name, places)


def photos_below(folder: Path) -> list[Path]:
    """Return all photos below a folder, except hidden ones, sorted by path."""
    return sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")
    )


def city_missing_error(base: Path, missing: Iterable[str], available: Sequence[str]) -> NotFound:
    """Return the error for missing cities; it lists the available ones."""
    return NotFound(
        "city_missing",
        f"{base} has no city {', '.join(missing)}. Available: {', '.join(available) or 'none'}. "
        "Use these, or download the missing ones.",
        missing=list(missing),
        there=list(available),
    )
