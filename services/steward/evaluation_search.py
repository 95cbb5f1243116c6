"""The photos of a map whose place is known, and which of them show a given place.

Asking one generation of a live map with its own photos, through the search tier.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.chunks import Descriptor, find_descriptor
from shared.catalog.generations import Generation
from shared.catalog.photos import Photo, PhotoRole, is_geotagged
from shared.catalog.session import Catalog
from shared.config.shards import is_shard_name
from shared.errors import Conflict, Gone, Unavailable
from shared.evaluation.place_evidence import PhotoLocation
from shared.geodesy import distances_m, latitude_bounds
from shared.search_api.protocol import SearchBackend, SearchHit, SearchRequest


@dataclass(frozen=True, slots=True)
class GeotaggedPhoto:
    """A described photo whose place is known."""

    photo_id: UUID
    spot: PhotoLocation
    captured_at: datetime | None


class GeotaggedPhotos:
    """Database photos by place: how many of them show one."""

    def __init__(self, photos: Sequence[GeotaggedPhoto]) -> None:
        self.photos = photos
        self._labels = Counter(p.spot.place for p in photos if p.spot.place is not None)
        on_earth = sorted(
            (p for p in photos if p.spot.latitude is not None), key=lambda p: p.spot.latitude or 0.0
        )
        self._ids = [photo.photo_id for photo in on_earth]
        self._spots = np.array(
            [(p.spot.latitude, p.spot.longitude) for p in on_earth], dtype=np.float64
        ).reshape(-1, 2)

    def count_at_place(self, spot: PhotoLocation, radius_m: float) -> int:
        """How many photos lie within `radius_m` of the spot, or bear its label: the larger count,
        so that one that does both counts once."""
        labelled = self._labels[spot.place] if spot.place is not None else 0
        return max(labelled, len(self._within(spot, radius_m)))

    def find_within(self, spot: PhotoLocation, radius_m: float) -> list[UUID]:
        """The photos that lie within `radius_m` of the spot; none where it has no coordinates."""
        return [self._ids[number] for number in self._within(spot, radius_m).tolist()]

    def _within(self, spot: PhotoLocation, radius_m: float) -> NDArray[np.int64]:
        if spot.latitude is None or spot.longitude is None:
            return np.empty(0, np.int64)
        south, north = latitude_bounds(spot.latitude, radius_m)
        first, last = np.searchsorted(self._spots[:, 0], [south, north])
        near = self._spots[first : last + 1]
        away = distances_m(spot.latitude, spot.longitude, near[:, 0], near[:, 1])
        found: NDArray[np.int64] = first + np.flatnonzero(away <= radius_m)
        return found


def read_geotagged_photos(
    session: Session, map_id: UUID, generation_id: UUID, role: PhotoRole
) -> list[GeotaggedPhoto]:
    """The live photos of a role that have a descriptor in the generation and a place, by id."""
    found = session.execute(
        select(Photo.id, Photo.latitude, Photo.longitude, Photo.place, Photo.captured_at)
        .join(Descriptor, Descriptor.photo_id == Photo.id)
        .where(
            Photo.map_id == map_id,
            Descriptor.generation_id == generation_id,
            Photo.deleted_at.is_(None),
            Photo.role == role,
            is_geotagged(),
        )
        .order_by(Photo.id)
    )
    return [GeotaggedPhoto(row[0], PhotoLocation(*row[1:4]), row[4]) for row in found]


MAX_READ_ATTEMPTS = 2

UNKNOWN_LOCATION = PhotoLocation(None, None, None)

LocatedRanking = list[tuple[SearchHit, PhotoLocation]]
RankPhoto = Callable[[GeotaggedPhoto, int], LocatedRanking | None]
"""`Asker.ask`, with the weights chosen."""


class EvaluationSearch:
    """Asks with stored photos; `photos` are those whose spots are known."""

    def __init__(
        self,
        catalog: Catalog,
        search: SearchBackend,
        generation: Generation,
        version: int,
        photos: Mapping[UUID, GeotaggedPhoto],
    ) -> None:
        self._catalog = catalog
        self._search = search
        self._generation = generation
        self._version = version
        self._photos = photos

    def rank_similar(
        self,
        query: GeotaggedPhoto,
        k: int,
        weights: tuple[float, ...] = (),
        excluded_photos: tuple[UUID, ...] = (),
    ) -> LocatedRanking | None:
        """The k most similar database photos and their spots, without the query itself and those
        of `excluded_photos`; None for a query that was deleted since. Conflict (`map_damaged`)
        when a part
        can't be searched."""
        for attempt in range(1, MAX_READ_ATTEMPTS + 1):
            with self._catalog.read() as session:
                found = find_descriptor(session, self._generation.id, query.photo_id)
            if found is None:
                return None
            descriptor, chunk = found
            request = SearchRequest(
                map_id=self._generation.map_id,
                generation_id=self._generation.id,
                object_key=chunk.object_key,
                row=descriptor.row,
                min_version=self._version,
                k=k,
                exclude=(query.photo_id, *excluded_photos),
                word_weights=weights,
            )
            try:
                answer = self._search.search(request)
            except Gone:  # its chunk was merged into another between the two calls
                if attempt == MAX_READ_ATTEMPTS:
                    raise
                continue
            except Unavailable as error:
                if error.code == "chunk_unreadable":
                    raise map_damaged_error([chunk.object_key]) from error
                raise
            if any(is_shard_name(part) for part in answer.missing):
                raise Unavailable(
                    "search_incomplete",
                    f"Without {', '.join(answer.missing)} the figures would be those of a part "
                    "of the map.",
                )
            if answer.missing:
                raise map_damaged_error(answer.missing)
            return [(hit, self._location(hit)) for hit in answer.hits]
        raise AssertionError("the last try returns or raises")

    def _location(self, hit: SearchHit) -> PhotoLocation:
        found = self._photos.get(hit.photo_id)
        return found.spot if found else UNKNOWN_LOCATION


def map_damaged_error(missing: Sequence[str]) -> Conflict:
    """What figures of the rest would hide."""
    return Conflict(
        "map_damaged",
        f"{', '.join(missing)} can't be read, and figures of a part of the map would mislead. "
        "Restore it from a backup, or describe its photos again, then evaluate.",
    )
