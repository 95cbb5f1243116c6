"""Which rows of a chunk may be answered: the filter of a search as a mask."""

from __future__ import annotations

from collections.abc import Collection
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.snapshot import PhotoColumns, as_microseconds
from shared.geodesy import distances_m
from shared.photo_filter import Box, PhotoFilter

Mask = NDArray[np.bool_]


def select(photos: PhotoColumns, wanted: PhotoFilter, exclude: Collection[UUID]) -> Mask:
    """(n,) bool: findable photos that pass the filter and are not excluded.

    The same photos that `catalog.metadata_search.filter_conditions` lets pass in SQL.
    """
    mask = photos.findable.copy()
    if wanted.near is not None:
        here = wanted.near
        away = distances_m(here.latitude, here.longitude, photos.latitude, photos.longitude)
        mask &= away <= here.radius_m  # False for NaN: without coordinates
    if wanted.box is not None:
        mask &= _inside(photos, wanted.box)
    if wanted.captured_after is not None:
        mask &= photos.captured_at >= as_microseconds(wanted.captured_after)
    if wanted.captured_before is not None:
        mask &= photos.captured_at <= as_microseconds(wanted.captured_before)
    if wanted.place is not None:
        mask &= photos.place == wanted.place
    if wanted.ids is not None:
        mask &= _one_of(photos, wanted.ids)
    if wanted.tags:
        tags = frozenset(wanted.tags)
        mask &= np.fromiter((tags <= has for has in photos.tags), bool, len(mask))
    if exclude:
        mask &= ~_one_of(photos, exclude)
    return mask


def _inside(photos: PhotoColumns, box: Box) -> Mask:
    longitude = np.abs(photos.latitude) == 90.0
    for west, east in box.longitude_ranges():
        longitude |= (photos.longitude >= west) & (photos.longitude <= east)
    inside: Mask = (photos.latitude >= box.south) & (photos.latitude <= box.north) & longitude
    return inside


def _one_of(photos: PhotoColumns, ids: Collection[UUID]) -> Mask:
    wanted = frozenset(ids)
    return np.fromiter((id_ in wanted for id_ in photos.photo_id), bool, len(photos.photo_id))
