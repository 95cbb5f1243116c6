"""Search client of evaluations: ranks a map's own geotagged photos through the search tier.

Also the index of geotagged photos, which counts those that show a given place.
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
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.photos import Photo, PhotoRole, is_geotagged
from shared.config.shards import is_shard_name
from shared.errors import Conflict, Gone, Unavailable
from shared.evaluation.places.evidence import PhotoLocation
from shared.geodesy import distances_m, latitude_bounds
from shared.search_api.photo_filter import PhotoFilter
from shared.search_api.protocol import SearchBackend, SearchHit, SearchRequest


@dataclass(frozen=True, slots=True)
class GeotaggedPhoto:
    """A described photo with coordinates or a place label."""

    photo_id: UUID
    spot: PhotoLocation
    captured_at: datetime | None


class GeotaggedPhotos:
    """Index of database photos by place."""

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
        """Count the photos within `radius_m` metres of the spot, or with its place label.

        Returns the larger of the two counts, so that a photo that meets both is counted once.
        """
        labelled = self._labels[spot.place] if spot.place is not None else 0
        return max(labelled, len(self._within(spot, radius_m)))

    def find_within(self, spot: PhotoLocation, radius_m: float) -> list[UUID]:
        """Return the photos within `radius_m` metres; none for a spot without coordinates."""
        return [self._ids[index] for index in self._within(spot, radius_m).tolist()]

    def _within(self, spot: PhotoLocation, radius_m: float) -> NDArray[np.int64]:
        if spot.latitude is None or spot.longitude is None:
            return np.empty(0, np.int64)
        south, north = latitude_bounds(spot.latitude, radius_m)
        first, last = np.searchsorted(self._spots[:, 0], [south, north])
        candidates = self._spots[first : last + 1]
        distances = distances_m(spot.latitude, spot.longitude, candidates[:, 0], candidates[:, 1])
        indices: NDArray[np.int64] = first + np.flatnonzero(distances <= radius_m)
        return indices


def read_geotagged_photos(
    session: Session, map_id: UUID, generation_id: UUID, role: PhotoRole
) -> list[GeotaggedPhoto]:
    """Return the live geotagged photos of a role with a descriptor in the generation, by id."""
    photos = session.execute(
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
    return [GeotaggedPhoto(row[0], PhotoLocation(*row[1:4]), row[4]) for row in photos]


MAX_READ_ATTEMPTS = 2

UNKNOWN_LOCATION = PhotoLocation(None, None, None)

LocatedRanking = list[tuple[SearchHit, PhotoLocation]]
RankPhoto = Callable[[GeotaggedPhoto, int], LocatedRanking | None]
"""`EvaluationSearch.rank_similar` with its weights bound."""


@dataclass(frozen=True, slots=True)
class EvaluationSearch:
    """Searches one generation of a map with its stored photos.

    `version` is the map version that search workers must have loaded; `photos` are the geotagged
    photos by id, for the locations of results.
    """

    catalog: Catalog
    search: SearchBackend
    generation: Generation
    version: int
    photos: Mapping[UUID, GeotaggedPhoto]

    def rank_similar(
        self,
        query: GeotaggedPhoto,
        k: int,
        weights: tuple[float, ...] = (),
        excluded_photos: tuple[UUID, ...] = (),
    ) -> LocatedRanking | None:
        """Return the k most similar geotagged database photos with their locations.

        The query photo is excluded, too. Without word weights, the ranking is unweighted.

        Returns:
            The ranking, best first; None if the query was deleted since.

        Raises:
            Conflict: `map_damaged`: a chunk can't be read.
            Unavailable: `search_incomplete`: a shard did not answer.
        """
        for attempt in range(1, MAX_READ_ATTEMPTS + 1):
            with self.catalog.read() as session:
                location = find_descriptor(session, self.generation.id, query.photo_id)
            if location is None:
                return None
            descriptor, chunk = location
            request = SearchRequest(
                map_id=self.generation.map_id,
                generation_id=self.generation.id,
                object_key=chunk.object_key,
                row=descriptor.row,
                min_version=self.version,
                k=k,
                photos=PhotoFilter(has_place=True),
                exclude=(query.photo_id, *excluded_photos),
                word_weights=weights,
            )
            try:
                answer = self.search.search(request)
            except Gone:  # its chunk was merged into another one between the two calls
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
                    f"Shards {', '.join(answer.missing)} did not answer: the results would cover "
                    "only a part of the map.",
                )
            if answer.missing:
                raise map_damaged_error(answer.missing)
            return [
                (hit, self.photos[hit.photo_id].spot)
                for hit in answer.hits
                if hit.photo_id in self.photos  # not one that was given its place since
            ]
        raise AssertionError("the last attempt returns or raises")


def map_damaged_error(missing: Sequence[str]) -> Conflict:
    """Return the error for chunks that can't be read: results without them would mislead."""
    return Conflict(
        "map_damaged",
        f"{', '.join(missing)} can't be read, and results for a part of the map would be "
        "misleading. Restore it from a backup, or describe its photos again, then evaluate.",
    )
