"""UTM coordinates of photos: conversion, several zones on one plane, distances of pairs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import utm
from numpy.typing import NDArray

from lab.datasets.dataset import PHOTO_TABLE_HEADER, DatasetPhoto, Indices
from shared.errors import InvalidRequest
from shared.geodesy import distance_m

UtmGrid = tuple[int, bool]
"""Zone number, and whether it is on the northern hemisphere; metres of one grid are comparable"""
Positions = NDArray[np.float64]

ZONES = 60
NEAR_ZONES = 2
"""Zones to each side that are projected into a zone. A photo beyond is within no rule's radius;
around Svalbard neighbouring zones have numbers that differ by two."""


def add_utm_positions(photos: Iterable[DatasetPhoto]) -> tuple[DatasetPhoto, ...]:
    """Add UTM metres and zone to photos that only have latitude and longitude.

    Raises InvalidRequest (`bad_coordinates`).
    """
    located = list(photos)
    by_grid: dict[UtmGrid, list[int]] = {}
    for number, photo in enumerate(located):
        latitude, longitude = photo.latitude, photo.longitude
        if photo.easting is not None or latitude is None or longitude is None:
            continue
        if not (-80 <= latitude <= 84 and -180 <= longitude <= 180):
            raise InvalidRequest(
                "bad_coordinates",
                f"{photo.name}: {latitude:g}, {longitude:g} is outside of UTM, which covers 80 "
                "degrees south to 84 degrees north.",
            )
        zone = int(utm.latlon_to_zone_number(latitude, longitude))
        by_grid.setdefault((zone, latitude >= 0), []).append(number)
    for (zone, northern), numbers in by_grid.items():
        degrees = [(located[number].latitude, located[number].longitude) for number in numbers]
        metres = utm.from_latlon(
            *np.array(degrees, np.float64).T, force_zone_number=zone, force_northern=northern
        )[:2]
        for number, (east, north) in zip(numbers, np.stack(metres, 1).tolist(), strict=True):
            letter = utm.latitude_to_zone_letter(located[number].latitude)
            located[number] = replace(
                located[number], easting=east, northing=north, zone=f"{zone:02d}{letter}"
            )
    return tuple(located)


def utm_positions(photos: Sequence[DatasetPhoto]) -> tuple[Positions, list[UtmGrid | None]]:
    """Return (n, 2) UTM metres and the grid of each photo; None if its zone is unknown.

    Raises InvalidRequest: `no_positions`, `bad_coordinates`.
    """
    missing = [photo.name for photo in photos if not has_position(photo)]
    if missing:
        raise InvalidRequest(
            "no_positions",
            f"{len(missing)} of {len(photos)} photos have no position (first: {missing[0]}). "
            "Positions are read from @UTM@ file names, a CSV or EXIF. Without positions, use "
            "another rule: frames N, or place-label. The header of a CSV is "
            f"{PHOTO_TABLE_HEADER}; all columns but path are optional.",
            missing=missing[:20],
        )
    located = add_utm_positions(photos)
    metres = np.array([(photo.easting, photo.northing) for photo in located], np.float64)
    grids = [parse_utm_grid(photo.zone, photo.name) if photo.zone else None for photo in located]
    return metres.reshape(-1, 2), grids


def group_by_utm_plane(
    queries: tuple[Positions, Sequence[UtmGrid | None]],
    database: tuple[Positions, Sequence[UtmGrid | None]],
) -> Iterator[tuple[Indices, Indices, Positions, Positions]]:
    """Group photos into UTM planes within which metres are comparable.

    There is one plane for each grid of the queries; every query is in exactly one. A plane contains
    all database photos of its grid, and those of near grids, projected into it. If the photos have
    at most one known grid, all photos are in one plane. The arguments are those that
    `utm_positions` returns.

    Yields query indices, ascending database indices, and the (n, 2) and (m, 2) metres of both.
    Raises InvalidRequest (`no_utm_zone`) if there are several grids and some photos have none.
    """
    (query_metres, query_grids), (metres, grids) = queries, database
    known = {grid for grid in (*query_grids, *grids) if grid is not None}
    if len(known) <= 1:
        yield np.arange(len(query_metres)), np.arange(len(metres)), query_metres, metres
        return
    if None in query_grids or None in grids:
        raise InvalidRequest(
            "no_utm_zone",
            f"The photos lie in {len(known)} UTM zones, but some have no zone, so their distances "
            "to the others are unknown. Give each photo its zone.",
        )
    for plane in sorted(known & set(query_grids)):
        projected = np.full_like(metres, np.nan)
        for grid in known & set(grids):
            apart = (grid[0] - plane[0]) % ZONES
            if min(apart, ZONES - apart) <= NEAR_ZONES:
                rows = _rows_of(grids, grid)
                projected[rows] = _project(metres[rows], grid, plane)
        near = np.flatnonzero(~np.isnan(projected[:, 0]))
        rows = _rows_of(query_grids, plane)
        yield rows, near, query_metres[rows], projected[near]


def _rows_of(grids: Sequence[UtmGrid | None], grid: UtmGrid) -> Indices:
    return np.array([row for row, each in enumerate(grids) if each == grid], np.int64)


def _project(metres: Positions, grid: UtmGrid, plane: UtmGrid) -> Positions:
    if grid == plane:
        return metres
    latitudes, longitudes = utm.to_latlon(*metres.T, grid[0], northern=grid[1], strict=False)
    east, north, _, _ = utm.from_latlon(
        latitudes,
        np.mod(longitudes + 180.0, 360.0) - 180.0,
        force_zone_number=plane[0],
        force_northern=plane[1],  # northings continue across the equator
    )
    return np.column_stack((east, north))


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
    if number.isdecimal() and 1 <= int(number) <= ZONES and letter in "CDEFGHJKLMNPQRSTUVWX":
        return int(number), letter >= "N"
    raise InvalidRequest("bad_coordinates", f"{name}: {zone!r} is not a UTM zone.")


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
