"""Which rows may be answered: the filter of a search as a mask."""

from __future__ import annotations

from collections.abc import Collection
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.photo_columns import Columns, as_microseconds, rows_of
from shared.geodesy import distances_m
from shared.photo_filter import Box, PhotoFilter

Mask = NDArray[np.bool_]
NO_ROWS = np.empty(0, np.int64)


def select(photos: Columns, wanted: PhotoFilter, exclude: Collection[UUID]) -> Mask:
    """(n,) bool: findable photos that pass the filter and are not excluded.

    The same photos that `catalog.metadata_search.filter_conditions` lets pass in SQL. What reads
    an index goes first; what computes is computed for the rows that are left.
    """
    mask = photos.findable.copy()
    if wanted.ids is not None:
        mask &= _among(rows_of(photos, wanted.ids), len(mask))
    if wanted.place is not None:
        mask &= _among(photos.rows_by_place.get(wanted.place, NO_ROWS), len(mask))
    for tag in wanted.tags:
        mask &= _among(photos.rows_by_tag.get(tag, NO_ROWS), len(mask))
    if exclude:
        mask[rows_of(photos, exclude)] = False
    if wanted.captured_after is not None:
        mask &= photos.captured_at >= as_microseconds(wanted.captured_after)
    if wanted.captured_before is not None:
        mask &= photos.captured_at <= as_microseconds(wanted.captured_before)
    if wanted.box is not None:
        mask &= _inside(photos, wanted.box)
    if wanted.near is not None:
        here = wanted.near
        left = np.flatnonzero(mask)
        away = distances_m(
            here.latitude, here.longitude, photos.latitude[left], photos.longitude[left]
        )
        mask[left] = away <= here.radius_m  # False for NaN: without coordinates
    return mask


def _inside(photos: Columns, box: Box) -> Mask:
    longitude = np.abs(photos.latitude) == 90.0
    for west, east in box.longitude_ranges():
        longitude |= (photos.longitude >= west) & (photos.longitude <= east)
    inside: Mask = (photos.latitude >= box.south) & (photos.latitude <= box.north) & longitude
    return inside


def _among(rows: NDArray[np.int64], count: int) -> Mask:
    mask = np.zeros(count, bool)
    mask[rows] = True
    return mask
