"""What each layout can do: tell its folders from others, and read them.

What training layouts by city share: which cities are meant, and numbers that don't clash.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from shared.datasets.dataset import DatasetPhoto, Indices, TrainingPlace, TrainingSet
from shared.errors import NotFound
from shared.imaging.file_formats import PHOTO_SUFFIXES

PLACEWISE_PROTOCOL = "placewise"
"""The protocol of a set that is taken as it lies there: all photos, all queries, safe over zones"""
DEFAULT_RULE = "radius 25 m"
"""The rule of nearly all published figures."""


@dataclass(frozen=True, slots=True)
class ListedSet:
    """An evaluation set as its layout lists it, before a rule has found positives."""

    database: tuple[DatasetPhoto, ...]
    queries: tuple[DatasetPhoto, ...]
    rule: str = DEFAULT_RULE
    """The rule that this set is measured by when none is asked for."""
    positives: tuple[Indices, ...] | None = None
    """By that rule, of a set that brings its own ground truth."""
    drops_queries: bool = False
    """Whether the protocol leaves queries without positives out."""


class TrainingLayout(Protocol):
    """Places to learn from. `base` is a folder that `recognises` has said yes to."""

    @property
    def name(self) -> str: ...

    def recognises(self, base: Path) -> bool: ...

    def cities(self, base: Path) -> tuple[str, ...]:
        """In order of their names."""
        ...

    def open(self, base: Path, cities: Sequence[str] | None, min_photos: int) -> TrainingSet:
        """The cities in the order asked; all of them when None."""
        ...


class EvaluationLayout(Protocol):
    """Sets of database photos and queries."""

    @property
    def name(self) -> str: ...

    @property
    def protocols(self) -> tuple[str, ...]:
        """The first is taken when none is asked for."""
        ...

    def sets(self, base: Path, prefix: str) -> Mapping[str, str]:
        """What `open` takes, by the name of each set in `base`; {} for a folder of another layout.

        `prefix` begins the names of sets that have none of their own.
        """
        ...

    def open(self, base: Path, key: str, protocol: str) -> ListedSet: ...


def photos_below(folder: Path) -> list[Path]:
    """Every photo below the folder, hidden ones left out, in the order of the paths' parts."""
    return sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")
    )


def city_missing_error(base: Path, missing: Iterable[str], available: Sequence[str]) -> NotFound:
    """The error that names the cities which are not there, and those which are."""
    return NotFound(
        "city_missing",
        f"{base} has no city {', '.join(missing)}. There are: {', '.join(available) or 'none'}. "
        "Name some of these, or download the missing ones.",
        missing=list(missing),
        there=list(available),
    )


PLACE_ID_STEP = 10**5
"""between the place numbers of two cities, as GSV-Cities has it"""

CityPhotos = dict[int, list[Path]]
"""the photos of each place of one city, by the city's own number of the place"""


def select_cities(
    base: Path, requested: Sequence[str] | None, available: Sequence[str]
) -> list[str]:
    """The asked cities as they are written there; doubles count once. NotFound (`city_missing`)."""
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
    """The places with enough photos, city after city, each city's by number.

    The i-th city's numbers grow by `i * STEP`. Where a city counts on beyond STEP, the step of all
    is the next power of ten above its largest number.
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
