"""Interfaces of dataset layouts, and helpers for training sets of several cities."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from lab.datasets.dataset import DatasetPhoto, Indices, TrainingPlace, TrainingSet
from shared.errors import NotFound
from shared.imaging.file_formats import PHOTO_SUFFIXES

PLACEWISE_PROTOCOL = "placewise"
"""The default protocol: all photos, all queries, correct across UTM zones"""
DEFAULT_RULE = "radius 25 m"
"""The positive-match criterion of nearly all published results."""


@dataclass(frozen=True, slots=True)
class ListedSet:
    """An evaluation set as its layout lists it, before positives are computed."""

    database: tuple[DatasetPhoto, ...]
    queries: tuple[DatasetPhoto, ...]
    rule: str = DEFAULT_RULE
    """The default positive-match criterion of the set."""
    positives: tuple[Indices, ...] | None = None
    """Positives by that rule, if the set includes a ground truth."""
    drops_queries: bool = False
    """Whether the protocol excludes queries without positives."""


class TrainingLayout(Protocol):
    """A layout of training sets. `base` is a folder for which `recognises` is true."""

    @property
    def name(self) -> str: ...

    def recognises(self, base: Path) -> bool:
        """Whether the folder has this layout."""
        ...

    def cities(self, base: Path) -> tuple[str, ...]:
        """Return the names of the cities, sorted."""
        ...

    def open(self, base: Path, cities: Sequence[str] | None, min_photos: int) -> TrainingSet:
        """Open the given cities, in their order; None opens all."""
        ...


class EvaluationLayout(Protocol):
    """A layout of evaluation sets."""

    @property
    def name(self) -> str: ...

    @property
    def protocols(self) -> tuple[str, ...]:
        """Names of the protocols; the first is the default."""
        ...

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        """Return the key for `open` by the name of each set in `base`; {} for other layouts.

        `prefix` is the first part of generated names.
        """
        ...

    def open(self, base: Path, key: str, protocol: str) -> ListedSet:
        """Read the photos of a set."""
        ...


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


PLACE_ID_STEP = 10**5
"""Offset between the place ids of two cities, as in GSV-Cities"""

CityPhotos = dict[int, list[Path]]
"""The photos of each place of a city, by the city's own place id"""


def select_cities(
    base: Path, requested: Sequence[str] | None, available: Sequence[str]
) -> list[str]:
    """Return the requested cities in their stored spelling, without duplicates.

    Raises NotFound (`city_missing`).
    """
    if requested is None:
        return list(available)
    known = {city.lower(): city for city in available}
    missing = [city for city in requested if city.lower() not in known]
    if missing:
        raise city_missing_error(base, missing, available)
    return list(dict.fromkeys(known[city.lower()] for city in requested))


def number_places(
    cities: Mapping[str, CityPhotos] | Iterable[tuple[str, CityPhotos]], min_photos: int
) -> tuple[TrainingPlace, ...]:
    """Return the places with at least `min_photos` photos, city by city, sorted by id.

    The i-th city's ids are offset by `i * PLACE_ID_STEP`. If any id is not below PLACE_ID_STEP, the
    step is the next power of ten above the largest id.
    """
    named = list(cities.items() if isinstance(cities, Mapping) else cities)
    largest = max((max(photos, default=0) for _, photos in named), default=0)
    step = PLACE_ID_STEP
    while step <= largest:
        step *= 10
    return tuple(
        TrainingPlace(place + index * step, city, tuple(photos[place]))
        for index, (city, photos) in enumerate(named)
        for place in sorted(photos)
        if len(photos[place]) >= min_photos
    )
