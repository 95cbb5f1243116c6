"""What training layouts by city share: which cities are meant, and numbers that don't clash."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from shared.datasets.layouts.layout import city_missing_error
from shared.datasets.shots import TrainingPlace

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
