"""UTM positions of photos in more than one zone, put on one plane so that metres are metres.

How far two photos of each pair were taken from each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import utm
from numpy.typing import NDArray

from shared.datasets.dataset import DatasetPhoto
from shared.errors import InvalidRequest
from shared.geodesy import distance_m

UtmGrid = tuple[int, bool]
"""zone number, and whether it is counted from the equator northwards: metres of one grid compare"""
Positions = NDArray[np.float64]

MAX_ZONE_SPAN_DEGREES = 9.0
"""Of longitude from a zone's meridian. No zone is wider than 6 degrees to one side; beyond 9 the
series of the projection loses millimetres, and nothing there is within any rule's radius."""


def utm_positions(shots: Sequence[DatasetPhoto]) -> tuple[Positions, list[UtmGrid | None]]:
    """(n, 2) UTM metres and each photo's grid, None where no zone is said.

    A photo with latitude and longitude alone is put into the zone that it lies in. Raises
    InvalidRequest (`no_positions`, `bad_coordinates`).
    """
    metres = np.full((len(shots), 2), np.nan)
    grids: list[UtmGrid | None] = [None] * len(shots)
    degrees: list[int] = []
    missing: list[str] = []
    for number, shot in enumerate(shots):
        if shot.easting is not None and shot.northing is not None:
            metres[number] = shot.easting, shot.northing
            grids[number] = None if shot.zone is None else parse_utm_grid(shot.zone, shot.name)
        elif shot.latitude is not None and shot.longitude is not None:
            degrees.append(number)
        else:
            missing.append(shot.name)
    if missing:
        raise InvalidRequest(
            "no_positions",
            f"{len(missing)} of {len(shots)} photos have no position (the first: {missing[0]}). "
            "It can stand in an @UTM@ file name, a CSV or EXIF; a set without positions needs "
            "another rule: frames N, or place-label.",
            missing=missing[:20],
        )
    _project(shots, degrees, metres, grids)
    return metres, grids


def group_by_utm_plane(
    queries: tuple[Positions, Sequence[UtmGrid | None]],
    database: tuple[Positions, Sequence[UtmGrid | None]],
) -> list[tuple[NDArray[np.int64], NDArray[np.int64], Positions, Positions]]:
    """Query indices, database indices, and the (n, 2) and (m, 2) metres of both on one plane.

    One plane for each grid that queries lie in; every query is on exactly one. Of the database, a
    plane has all photos of its grid as they are, and those of other grids near its zone, projected
    into it. Where no photo says a zone all are taken for neighbours, and so are those without one
    where there is only one other. Raises InvalidRequest (`no_utm_zone`) where that is ambiguous.
    """
    known = sorted({grid for grid in (*queries[1], *database[1]) if grid is not None})
    if len(known) <= 1:
        everyone = np.arange(len(queries[0])), np.arange(len(database[0]))
        return [(*everyone, queries[0], database[0])]
    if None in queries[1] or None in database[1]:
        raise InvalidRequest(
            "no_utm_zone",
            f"The photos lie in {len(known)} UTM zones, and some say none: it is unknown how far "
            "they are from the others. Give each photo its zone.",
        )
    query_numbers, numbers = _numbered(known, queries[1]), _numbered(known, database[1])
    latitudes, longitudes = _degrees(known, numbers, database[0])
    found = []
    for plane in np.unique(query_numbers):
        grid = known[plane]
        own = numbers == plane
        near = own | (np.abs(_apart(longitudes, _meridian(grid[0]))) <= MAX_ZONE_SPAN_DEGREES)
        guests = near & ~own
        metres = database[0].copy()
        if guests.any():
            east, north, _, _ = utm.from_latlon(
                latitudes[guests],
                longitudes[guests],
                force_zone_number=grid[0],
                force_northern=grid[1],  # over the equator the metres go on, without a step
            )
            metres[guests] = np.column_stack((east, north))
        asked = np.flatnonzero(query_numbers == plane)
        kept = np.flatnonzero(near)
        found.append((asked, kept, queries[0][asked], metres[kept]))
    return found


def utm_to_degrees(grid: UtmGrid, metres: Positions) -> tuple[float, float]:
    """Latitude and longitude of one position, (2,) UTM metres of the grid."""
    east, north = metres.tolist()
    latitude, longitude = utm.to_latlon(east, north, grid[0], northern=grid[1], strict=False)
    return float(latitude), float(longitude)


def parse_utm_grid(zone: str, name: str) -> UtmGrid:
    """`32T` -> (32, True). Raises InvalidRequest (`bad_coordinates`), which names the photo."""
    number, letter = zone[:-1], zone[-1:].upper()
    if number.isdecimal() and 1 <= int(number) <= 60 and letter in "CDEFGHJKLMNPQRSTUVWX":
        return int(number), letter >= "N"
    raise InvalidRequest("bad_coordinates", f"{name}: there is no UTM zone {zone!r}.")


def add_utm_positions(shots: Sequence[DatasetPhoto]) -> tuple[DatasetPhoto, ...]:
    """The photos, those with latitude and longitude alone also in UTM metres and with a zone."""
    degrees = [
        number
        for number, shot in enumerate(shots)
        if shot.easting is None and shot.latitude is not None and shot.longitude is not None
    ]
    metres = np.full((len(shots), 2), np.nan)
    grids: list[UtmGrid | None] = [None] * len(shots)
    _project(shots, degrees, metres, grids)
    known = list(shots)
    for number in degrees:
        shot = shots[number]
        grid = grids[number]
        assert grid is not None
        assert shot.latitude is not None
        east, north = metres[number].tolist()
        letter = utm.latitude_to_zone_letter(shot.latitude)
        known[number] = replace(shot, easting=east, northing=north, zone=f"{grid[0]:02d}{letter}")
    return tuple(known)


def _project(
    shots: Sequence[DatasetPhoto],
    degrees: Sequence[int],
    metres: Positions,
    grids: list[UtmGrid | None],
) -> None:
    """Fill in UTM metres and grids of the photos of these indices, all of one zone at once."""
    by_grid: dict[UtmGrid, list[int]] = {}
    for number in degrees:
        latitude, longitude = shots[number].latitude, shots[number].longitude
        assert latitude is not None
        assert longitude is not None
        if not (-80 <= latitude <= 84 and -180 <= longitude <= 180):
            raise InvalidRequest(
                "bad_coordinates",
                f"{shots[number].name}: {latitude:g}, {longitude:g} is outside of UTM, which "
                "reaches from 80 degrees south to 84 north.",
            )
        zone = int(utm.latlon_to_zone_number(latitude, longitude))
        by_grid.setdefault((zone, latitude >= 0), []).append(number)
    for grid, numbers in by_grid.items():
        # The asserts above have told that none of them is None.
        latitudes = np.array([shots[number].latitude for number in numbers], np.float64)
        longitudes = np.array([shots[number].longitude for number in numbers], np.float64)
        east, north, _, _ = utm.from_latlon(
            latitudes, longitudes, force_zone_number=grid[0], force_northern=grid[1]
        )
        metres[numbers] = np.column_stack((east, north))
        for number in numbers:
            grids[number] = grid


def _numbered(known: Sequence[UtmGrid], grids: Sequence[UtmGrid | None]) -> NDArray[np.int64]:
    number = {grid: index for index, grid in enumerate(known)}
    return np.array([number[grid] for grid in grids if grid is not None], np.int64)


def _degrees(
    known: Sequence[UtmGrid], numbers: NDArray[np.int64], metres: Positions
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    latitudes, longitudes = np.empty(len(metres)), np.empty(len(metres))
    for plane in np.unique(numbers):
        here = numbers == plane
        latitudes[here], longitudes[here] = utm.to_latlon(
            metres[here, 0],
            metres[here, 1],
            known[plane][0],
            northern=known[plane][1],
            strict=False,
        )
    return latitudes, _apart(longitudes, 0.0)


def _meridian(zone_number: int) -> float:
    return zone_number * 6.0 - 183.0


def _apart(longitudes: NDArray[np.float64], other: float) -> NDArray[np.float64]:
    """From `other` to these, in [-180, 180) degrees."""
    return np.mod(longitudes - other + 180.0, 360.0) - 180.0


def pairwise_distances_m(
    some: Sequence[DatasetPhoto], others: Sequence[DatasetPhoto]
) -> NDArray[np.float64]:
    """(n,) metres between the photos of each pair, NaN where one has no position.

    Straight in the plane of the UTM zone that both lie in; over a zone's border on the sphere.
    """
    metres = np.full(len(some), np.nan)
    placed = [
        number
        for number, pair in enumerate(zip(some, others, strict=True))
        if all(has_position(shot) for shot in pair)
    ]
    here, zones = utm_positions([some[number] for number in placed])
    there, other_zones = utm_positions([others[number] for number in placed])
    metres[placed] = np.hypot(*(there - here).T)
    for index, number in enumerate(placed):
        zone, other = zones[index], other_zones[index]
        if zone != other and zone is not None and other is not None:
            metres[number] = distance_m(
                *utm_to_degrees(zone, here[index]), *utm_to_degrees(other, there[index])
            )
    return metres


def has_position(shot: DatasetPhoto) -> bool:
    return None not in (shot.easting, shot.northing) or None not in (shot.latitude, shot.longitude)
