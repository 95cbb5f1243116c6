"""Which rows may be answered: the filter of a search as a mask."""

from __future__ import annotations

from collections.abc import Collection
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.photo_columns import AnyPhotoColumns, find_rows, to_datetime64
from shared.geodesy import distances_m
from shared.photo_filter import Box, PhotoFilter

RowMask = NDArray[np.bool_]
NO_ROWS = np.empty(0, np.int64)


def build_row_mask(
    photos: AnyPhotoColumns, photo_filter: PhotoFilter, exclude: Collection[UUID]
) -> RowMask:
    """(n,) bool: findable photos that pass the filter and are not excluded.

    The same photos that `catalog.metadata_search.filter_conditions` lets pass in SQL. What reads
    an index goes first; what computes is computed for the rows that are left.
    """
    mask = photos.findable.copy()
    if photo_filter.ids is not None:
        mask &= _mask_of_rows(find_rows(photos, photo_filter.ids), len(mask))
    if photo_filter.place is not None:
        mask &= _mask_of_rows(photos.rows_by_place.get(photo_filter.place, NO_ROWS), len(mask))
    for tag in photo_filter.tags:
        mask &= _mask_of_rows(photos.rows_by_tag.get(tag, NO_ROWS), len(mask))
    if exclude:
        mask[find_rows(photos, exclude)] = False
    if photo_filter.captured_after is not None:
        mask &= photos.captured_at >= to_datetime64(photo_filter.captured_after)
    if photo_filter.captured_before is not None:
        mask &= photos.captured_at <= to_datetime64(photo_filter.captured_before)
    if photo_filter.box is not None:
        mask &= _in_box(photos, photo_filter.box)
    if photo_filter.near is not None:
        here = photo_filter.near
        left = np.flatnonzero(mask)
        away = distances_m(
            here.latitude, here.longitude, photos.latitude[left], photos.longitude[left]
        )
        mask[left] = away <= here.radius_m  # False for NaN: without coordinates
    return mask


def _in_box(photos: AnyPhotoColumns, box: Box) -> RowMask:
    longitude = np.abs(photos.latitude) == 90.0
    for west, east in box.longitude_ranges():
        longitude |= (photos.longitude >= west) & (photos.longitude <= east)
    inside: RowMask = (photos.latitude >= box.south) & (photos.latitude <= box.north) & longitude
    return inside


def _mask_of_rows(rows: NDArray[np.int64], count: int) -> RowMask:
    mask = np.zeros(count, bool)
    mask[rows] = True
    return mask
