"""Random filters, and what they mean: a reference that shares no arithmetic with the code."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from uuid import UUID

from hypothesis import strategies as some

from shared.catalog.photos import PhotoFilterValues, PhotoRole
from shared.geodesy import flush_to_zero
from shared.search_api.photo_filter import Box, Circle, PhotoFilter

RADIUS_M = 6_371_008.8
HALF_EARTH_M = math.pi * RADIUS_M
UNDECIDED_M = 0.001  # so near to a circle's edge, NumPy's and a database's sines may disagree

PLACES = ["hall", "Hall", "it's", "日本"]
TAGS = ["night", "Night", "wet", "50%", '"', "1", "[1]", "it's", "a\\b", "null", "Üben", "🏠"]
PARTS_OF_TAGS = ["NIGH", "t", "%", '"', "0", "5_", "\\", "Üb", "üb", "日"]
MOMENT = datetime(2024, 5, 6, 7, 8, 9, 123456, tzinfo=UTC)
MOMENTS = [
    MOMENT + delta
    for delta in (
        timedelta(0),
        timedelta(microseconds=1),
        timedelta(microseconds=-1),
        timedelta(microseconds=-123456),  # a whole second
        timedelta(days=365),
        timedelta(days=-40_000),  # before 1970, as a postcard may say
    )
]
IDS = [UUID(int=number) for number in range(1, 41)]

# The borders of the globe are drawn often: there two numbers are one point.
latitudes = some.sampled_from([-90.0, 90.0, 0.0, 45.0]) | some.floats(-90, 90)
longitudes = some.sampled_from([-180.0, 180.0, 0.0, 179.999999, -179.999999]) | some.floats(
    -180, 180
)
points = some.tuples(latitudes, longitudes)


@some.composite
def photo_facts(draw: some.DrawFn, photo_id: UUID) -> PhotoFilterValues:
    latitude, longitude = draw(some.tuples(some.none(), some.none()) | points)
    if latitude is not None and longitude is not None:  # as the catalog keeps them
        latitude, longitude = flush_to_zero(latitude), flush_to_zero(longitude)
    return PhotoFilterValues(
        photo_id=photo_id,
        role=draw(some.sampled_from(PhotoRole)),
        deleted_at=None,
        latitude=latitude,
        longitude=longitude,
        captured_at=draw(some.none() | some.sampled_from(MOMENTS)),
        place=draw(some.none() | some.sampled_from(PLACES)),
        tags=draw(some.lists(some.sampled_from(TAGS), unique=True, max_size=3)),
    )


@some.composite
def circles(draw: some.DrawFn, photos: list[PhotoFilterValues]) -> Circle:
    """Around a photo or anywhere; of no size, of the whole Earth, or up to just a photo."""
    spots = [(p.latitude, p.longitude) for p in photos if p.latitude is not None]
    centre = some.sampled_from(spots) if spots else points
    latitude, longitude = draw(centre | points)
    assert latitude is not None
    assert longitude is not None
    here = Fraction(latitude), Fraction(longitude)
    away = [metres(here[0], here[1], Fraction(a), Fraction(b)) for a, b in spots if b is not None]
    just = [max(0.0, metre + 2 * side) for metre in away for side in (UNDECIDED_M, -UNDECIDED_M)]
    radius_m = draw(
        some.sampled_from([0.0, HALF_EARTH_M, HALF_EARTH_M / 2, 1e300, *just])
        | some.floats(-3, 8).map(lambda power: 10.0**power)
    )
    return Circle(latitude=latitude, longitude=longitude, radius_m=radius_m)


@some.composite
def boxes(draw: some.DrawFn, photos: list[PhotoFilterValues]) -> Box:
    """Anywhere, also across the antimeridian, with corners on photos, and of no size."""
    spots = [(p.latitude, p.longitude) for p in photos if p.latitude is not None]
    corner = (some.sampled_from(spots) | points) if spots else points
    one = draw(corner)
    other = draw(some.just(one) | corner)
    assert one[0] is not None
    assert other[0] is not None
    south, north = sorted((one[0], other[0]))
    return Box(south=south, west=one[1], north=north, east=other[1])


@some.composite
def photo_filters(draw: some.DrawFn, photos: list[PhotoFilterValues]) -> PhotoFilter:
    """Each condition in one of four, so that most filters let some of the photos pass."""

    def sometimes(condition: some.SearchStrategy[object]) -> object:
        return draw(some.one_of(some.none(), some.none(), some.none(), condition))

    ids = [photo.photo_id for photo in photos]
    return PhotoFilter.model_validate(
        {
            "near": sometimes(circles(photos)),
            "box": sometimes(boxes(photos)),
            "captured_after": sometimes(some.sampled_from(MOMENTS)),
            "captured_before": sometimes(some.sampled_from(MOMENTS)),
            "place": sometimes(some.sampled_from(PLACES)),
            "tags": sometimes(some.lists(some.sampled_from(TAGS), max_size=2).map(tuple)) or (),
            "tags_like": sometimes(some.sampled_from(PARTS_OF_TAGS).map(lambda part: (part,)))
            or (),
            "ids": sometimes(some.lists(some.sampled_from(ids)).map(tuple)),
            "has_place": sometimes(some.just(True)) or False,
        }
    )


def passes(photo: PhotoFilterValues, photo_filter: PhotoFilter) -> bool | None:
    """Whether the filter lets the photo pass; None on the very edge of its circle."""
    certain = [
        photo_filter.box is None or _is_inside(photo, photo_filter.box),
        photo_filter.captured_after is None
        or (photo.captured_at is not None and photo.captured_at >= photo_filter.captured_after),
        photo_filter.captured_before is None
        or (photo.captured_at is not None and photo.captured_at <= photo_filter.captured_before),
        photo_filter.place is None or photo.place == photo_filter.place,
        all(tag in photo.tags for tag in photo_filter.tags),
        all(
            any(part.encode().lower() in tag.encode().lower() for tag in photo.tags)
            for part in photo_filter.tags_like
        ),
        photo_filter.ids is None or photo.photo_id in photo_filter.ids,
        not photo_filter.has_place or (photo.latitude, photo.place) != (None, None),
    ]
    if not all(certain):
        return False
    return True if photo_filter.near is None else _is_within(photo, photo_filter.near)


def _is_within(photo: PhotoFilterValues, circle: Circle) -> bool | None:
    if photo.latitude is None or photo.longitude is None:
        return False
    if (photo.latitude, photo.longitude) == (circle.latitude, circle.longitude):
        return True  # a circle of no size holds its centre
    if circle.radius_m >= HALF_EARTH_M:
        return True
    away = metres(
        Fraction(circle.latitude),
        Fraction(circle.longitude),
        Fraction(photo.latitude),
        Fraction(photo.longitude),
    )
    return None if abs(away - circle.radius_m) <= UNDECIDED_M else away < circle.radius_m


def _is_inside(photo: PhotoFilterValues, box: Box) -> bool:
    """By angles round the pole, in exact fractions."""
    if photo.latitude is None or photo.longitude is None:
        return False
    if not box.south <= photo.latitude <= box.north:
        return False
    if photo.latitude in (-90, 90):
        return True  # a pole has every longitude
    west, east = Fraction(box.west), Fraction(box.east)
    width = east - west if east >= west else east - west + 360
    return (Fraction(photo.longitude) - west) % 360 <= width


def metres(lat_1: Fraction, lon_1: Fraction, lat_2: Fraction, lon_2: Fraction) -> float:
    """The angle between two vectors, which is exact to nanometres at any distance."""
    one, other = _vector(lat_1, lon_1), _vector(lat_2, lon_2)
    cross = [
        one[(axis + 1) % 3] * other[(axis + 2) % 3] - one[(axis + 2) % 3] * other[(axis + 1) % 3]
        for axis in range(3)
    ]
    return RADIUS_M * math.atan2(
        math.hypot(*cross), math.fsum(map(math.prod, zip(one, other, strict=True)))
    )


def _vector(latitude: Fraction, longitude: Fraction) -> tuple[float, float, float]:
    phi, lam = math.radians(latitude), math.radians(longitude)
    return math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)
