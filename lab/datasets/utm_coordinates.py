"""UTM coordinates of photos: conversion, several zones on one plane, distances of pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import utm
from numpy.typing import NDArray

from lab.datasets.dataset import PHOTO_TABLE_HEADER, DatasetPhoto
from shared.errors import InvalidRequest
from shared.geodesy import distance_m

UtmGrid = tuple[int, bool]
"""Zone number, and whether it is on the northern hemisphere; metres of one grid are comparable"""
Positions = NDArray[np.float64]

MAX_ZONE_SPAN_DEGREES = 9.0
"""Maximum distance in longitude from a zone's meridian for projecting into the zone. No zone
extends more than 6 degrees to one side; beyond 9 degrees the projection is off by millimetres, and
no photo there is within the radius of any rule."""


def utm_positions(photos: Sequence[DatasetPhoto]) -> tuple[Positions, list[UtmGrid | None]]:
    """Return (n, 2) UTM metres and the grid of each photo.

    The grid is None if the photo's zone is unknown. Latitude and longitude alone are converted to
    the zone that they lie in.

    Raises InvalidRequest: `no_positions`, `bad_coordinates`.
    """
    metres = np.full((len(photos), 2), np.nan)
    grids: list[UtmGrid | None] = [None] * len(photos)
    degrees: list[int] = []
    missing: list[str] = []
    for number, photo in enumerate(photos):
        if photo.easting is not None and photo.northing is not None:
            metres[number] = photo.easting, photo.northing
            grids[number] = None if photo.zone is None else parse_utm_grid(photo.zone, photo.name)
        elif photo.latitude is not None and photo.longitude is not None:
            degrees.append(number)
        else:
            missing.append(photo.name)
    if missing:
        raise InvalidRequest(
            "no_positions",
            f"{len(missing)} of {len(photos)} photos have no position (first: {missing[0]}). "
            "Positions are read from @UTM@ file names, a CSV or EXIF. Without positions, use "
            "another rule: frames N, or place-label. The header of a CSV is "
            f"{PHOTO_TABLE_HEADER}; all columns but path are optional.",
            missing=missing[:20],
        )
    _project(photos, degrees, metres, grids)
    return metres, grids


def group_by_utm_plane(
    queries: tuple[Positions, Sequence[UtmGrid | None]],
    database: tuple[Positions, Sequence[UtmGrid | None]],
) -> list[tuple[NDArray[np.int64], NDArray[np.int64], Positions, Positions]]:
    """Group photos into UTM planes within which metres are comparable.

    There is one plane for each grid of the queries; every query is in exactly one. A plane contains
    all database photos of its grid, and those of other grids near its zone, projected into it. If
    the photos have at most one known grid, all photos are in one plane.

    Args:
        queries: (n, 2) UTM metres and grids, from `utm_positions`.

    Returns:
        For each plane: query indices, database indices, (n, 2) metres of the queries and (m, 2)
        metres of the database photos.

    Raises:
        InvalidRequest: `no_utm_zone` if there are several grids and some photos have none.
    """
    known = sorted({grid for grid in (*queries[1], *database[1]) if grid is not None})
    if len(known) <= 1:
        all_indices = np.arange(len(queries[0])), np.arange(len(database[0]))
        return [(*all_indices, queries[0], database[0])]
    if None in queries[1] or None in database[1]:
        raise InvalidRequest(
            "no_utm_zone",
            f"The photos lie in {len(known)} UTM zones, but some have no zone, so their distances "
            "to the others are unknown. Give each photo its zone.",
        )
    query_planes, database_planes = (
        _plane_numbers(known, queries[1]),
        _plane_numbers(known, database[1]),
    )
    latitudes, longitudes = _degrees(known, database_planes, database[0])
    groups = []
    for plane in np.unique(query_planes):
        grid = known[plane]
        in_plane = database_planes == plane
        near = in_plane | (
            np.abs(_longitude_difference(longitudes, _meridian(grid[0]))) <= MAX_ZONE_SPAN_DEGREES
        )
        projected = near & ~in_plane
        metres = database[0].copy()
        if projected.any():
            east, north, _, _ = utm.from_latlon(
                latitudes[projected],
                longitudes[projected],
                force_zone_number=grid[0],
                force_northern=grid[1],  # northings continue across the equator
            )
            metres[projected] = np.column_stack((east, north))
        query_rows = np.flatnonzero(query_planes == plane)
        database_rows = np.flatnonzero(near)
        groups.append((query_rows, database_rows, queries[0][query_rows], metres[database_rows]))
    return groups


def utm_to_degrees(grid: UtmGrid, metres: Positions) -> tuple[float, float]:
    """Convert (2,) UTM metres of a grid to latitude and longitude."""
    east, north = metres.tolist()
    latitude, longitude = utm.to_latlon(east, north, grid[0], northern=grid[1], strict=False)
    return float(latitude), float(longitude)


def parse_utm_grid(zone: str, name: str) -> UtmGrid:
    """Parse a UTM zone: `32T` -> (32, True).

    `name` is the photo's, for the error. Raises InvalidRequest (`bad_coordinates`).
    """
    number, letter = zone[:-1], zone[-1:].upper()
    if number.isdecimal() and 1 <= int(number) <= 60 and letter in "CDEFGHJKLMNPQRSTUVWX":
        return int(number), letter >= "N"
    raise InvalidRequest("bad_coordinates", f"{name}: {zone!r} is not a UTM zone.")


def add_utm_positions(photos: Sequence[DatasetPhoto]) -> tuple[DatasetPhoto, ...]:
    """Add UTM metres and zone to photos that only have latitude and longitude."""
    degrees = [
        number
        for number, photo in enumerate(photos)
        if photo.easting is None and photo.latitude is not None and photo.longitude is not None
    ]
    metres = np.full((len(photos), 2), np.nan)
    grids: list[UtmGrid | None] = [None] * len(photos)
    _project(photos, degrees, metres, grids)
    located = list(photos)
    for number in degrees:
        photo = photos[number]
        grid = grids[number]
        assert grid is not None
        assert photo.latitude is not None
        east, north = metres[number].tolist()
        letter = utm.latitude_to_zone_letter(photo.latitude)
        located[number] = replace(
            photo, easting=east, northing=north, zone=f"{grid[0]:02d}{letter}"
        )
    return tuple(located)


def _project(
    photos: Sequence[DatasetPhoto],
    degrees: Sequence[int],
    metres: Positions,
    grids: list[UtmGrid | None],
) -> None:
    """Set `metres` and `grids` of the photos with the indices `degrees`, one zone at a time."""
    by_grid: dict[UtmGrid, list[int]] = {}
    for number in degrees:
        latitude, longitude = photos[number].latitude, photos[number].longitude
        assert latitude is not None
        assert longitude is not None
        if not (-80 <= latitude <= 84 and -180 <= longitude <= 180):
            raise InvalidRequest(
                "bad_coordinates",
                f"{photos[number].name}: {latitude:g}, {longitude:g} is outside of UTM, which "
                "covers 80 degrees south to 84 degrees north.",
            )
        zone = int(utm.latlon_to_zone_number(latitude, longitude))
        by_grid.setdefault((zone, latitude >= 0), []).append(number)
    for grid, numbers in by_grid.items():
        # None of them is None: see the asserts above.
        latitudes = np.array([photos[number].latitude for number in numbers], np.float64)
        longitudes = np.array([photos[number].longitude for number in numbers], np.float64)
        east, north, _, _ = utm.from_latlon(
            latitudes, longitudes, force_zone_number=grid[0], force_northern=grid[1]
        )
        metres[numbers] = np.column_stack((east, north))
        for number in numbers:
            grids[number] = grid


def _plane_numbers(known: Sequence[UtmGrid], grids: Sequence[UtmGrid | None]) -> NDArray[np.int64]:
    plane_of = {grid: index for index, grid in enumerate(known)}
    return np.array([plane_of[grid] for grid in grids if grid is not None], np.int64)


def _degrees(
    known: Sequence[UtmGrid], planes: NDArray[np.int64], metres: Positions
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    latitudes, longitudes = np.empty(len(metres)), np.empty(len(metres))
    for plane in np.unique(planes):
        rows = planes == plane
        latitudes[rows], longitudes[rows] = utm.to_latlon(
            metres[rows, 0],
            metres[rows, 1],
            known[plane][0],
            northern=known[plane][1],
            strict=False,
        )
    return latitudes, _longitude_difference(longitudes, 0.0)


def _meridian(zone_number: int) -> float:
    return zone_number * 6.0 - 183.0


def _longitude_difference(longitudes: NDArray[np.float64], other: float) -> NDArray[np.float64]:
    """Return the differences to `other`, in [-180, 180) degrees."""
    return np.mod(longitudes - other + 180.0, 360.0) - 180.0


def pairwise_distances_m(
    first: Sequence[DatasetPhoto], second: Sequence[DatasetPhoto]
) -> NDArray[np.float64]:
    """Return the (n,) distances in metres of pairs; NaN if a photo has no position.

    Euclidean within a UTM zone, on the sphere across a zone's border.
    """
    metres = np.full(len(first), np.nan)
    located = [
        number
        for number, pair in enumerate(zip(first, second, strict=True))
        if all(has_position(photo) for photo in pair)
    ]
    first_metres, first_grids = utm_positions([first[number] for number in located])
    second_metres, second_grids = utm_positions([second[number] for number in located])
    metres[located] = np.hypot(*(second_metres - first_metres).T)
    for index, number in enumerate(located):
        from_grid, to_grid = first_grids[index], second_grids[index]
        if from_grid != to_grid and from_grid is not None and to_grid is not None:
            metres[number] = distance_m(
                *utm_to_degrees(from_grid, first_metres[index]),
                *utm_to_degrees(to_grid, second_metres[index]),
            )
    return metres


def has_position(photo: DatasetPhoto) -> bool:
    """Whether the photo has UTM metres, or latitude and longitude."""
    return None not in (photo.easting, photo.northing) or None not in (
        photo.latitude,
        photo.longitude,
    )
