"""Search client of evaluations: ranks and matches a map's own photos through the search tier.

Also the index of geotagged photos, which finds those that show a given place, and tells whether two
photos are frames of one sequence.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from uuid import UUID

import numpy as np
import sqlalchemy as sql
from sqlalchemy import select
from sqlalchemy.orm import Session

from shared.catalog.chunks import Descriptor, find_descriptor, find_feature_rows
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.photos import Photo, PhotoRole, has_given_place, is_geotagged
from shared.errors import Conflict, Gone, Unavailable
from shared.evaluation.places.evidence import PhotoLocation, match_support
from shared.evaluation.places.levels import CandidateLevel
from shared.geodesy import distances_m, latitude_bounds
from shared.search_api.photo_filter import PhotoFilter
from shared.search_api.protocol import (
    FeatureReference,
    MatchRequest,
    PhotoMatches,
    SearchBackend,
    SearchHit,
    SearchRequest,
)

SEQUENCE_PERIOD = timedelta(seconds=60)
SEQUENCE_NUMBERS = 60


@dataclass(frozen=True, slots=True)
class GeotaggedPhoto:
    """A described photo with coordinates or a place label."""

    photo_id: UUID
    spot: PhotoLocation
    captured_at: datetime | None
    name: str
    """its path in its folder, else its file name"""
    place_is_estimated: bool = False
    """whether its place is an accepted proposal"""
    denied: CandidateLevel | None = None
    """where it was not taken, as a person said; its place is not known then"""
    _name_parts: list[str] = field(init=False, compare=False)
    """text and digits of the name in turn"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "_name_parts", re.split(r"([0-9]+)", self.name))

    def is_right(self, level: CandidateLevel) -> bool | None:
        """Return whether the photo was taken in a level; None if that is not known."""
        if self.denied is None:
            return level.is_right(self.spot)
        return False if level.is_within(self.denied) else None

    def is_same_sequence(self, other: GeotaggedPhoto) -> bool:
        """Return whether two photos are frames of one walk, drive or video.

        They are if they were taken within `SEQUENCE_PERIOD`, or if one number in their names
        differs, by at most `SEQUENCE_NUMBERS`, and nothing else does. The catalog does not know
        the camera: photos that two cameras took in the same minute count as one sequence.
        """
        times = (self.captured_at, other.captured_at)
        if times[0] and times[1] and abs(times[0] - times[1]) <= SEQUENCE_PERIOD:
            return True
        mine, others = self._name_parts, other._name_parts
        if len(mine) != len(others):
            return False
        different = [i for i, (a, b) in enumerate(zip(mine, others, strict=True)) if a != b]
        if len(different) != 1 or different[0] % 2 == 0:
            return False
        (number,) = different
        return abs(int(mine[number]) - int(others[number])) <= SEQUENCE_NUMBERS


class GeotaggedPhotos:
    """Index of database photos by place."""

    def __init__(self, photos: Sequence[GeotaggedPhoto]) -> None:
        self.photos = photos
        self._by_label: defaultdict[str, list[GeotaggedPhoto]] = defaultdict(list)
        for photo in photos:
            if photo.spot.place is not None:
                self._by_label[photo.spot.place].append(photo)
        self._on_earth = sorted(
            (p for p in photos if p.spot.latitude is not None), key=lambda p: p.spot.latitude or 0.0
        )
        self._spots = np.array(
            [(p.spot.latitude, p.spot.longitude) for p in self._on_earth], dtype=np.float64
        ).reshape(-1, 2)

    def find_at_place(self, spot: PhotoLocation, radius_m: float) -> list[GeotaggedPhoto]:
        """Return the photos within `radius_m` metres of the spot, or with its place label."""
        near = self.find_within(spot, radius_m)
        if spot.place is None:
            return near
        return [*self._by_label[spot.place], *(p for p in near if p.spot.place != spot.place)]

    def find_within(self, spot: PhotoLocation, radius_m: float) -> list[GeotaggedPhoto]:
        """Return the photos within `radius_m` metres; none for a spot without coordinates."""
        if spot.latitude is None or spot.longitude is None:
            return []
        south, north = latitude_bounds(spot.latitude, radius_m)
        first, last = np.searchsorted(self._spots[:, 0], [south, north])
        candidates = self._spots[first : last + 1]
        distances = distances_m(spot.latitude, spot.longitude, candidates[:, 0], candidates[:, 1])
        indices = first + np.flatnonzero(distances <= radius_m)
        return [self._on_earth[index] for index in indices.tolist()]


def read_geotagged_photos(
    session: Session, map_id: UUID, generation_id: UUID, role: PhotoRole | None
) -> list[GeotaggedPhoto]:
    """Return the live geotagged photos of a role with a descriptor in the generation, by id.

    None: photos without a place of which a person has denied one.
    """
    of_role = (Photo.role == role, is_geotagged())
    photos = session.execute(
        select(
            Photo.id,
            Photo.latitude,
            Photo.longitude,
            Photo.place,
            Photo.captured_at,
            sql.func.coalesce(Photo.relative_path, Photo.filename),
            Photo.given_place,
        )
        .join(Descriptor, Descriptor.photo_id == Photo.id)
        .where(
            Photo.map_id == map_id,
            Descriptor.generation_id == generation_id,
            Photo.deleted_at.is_(None),
            *(of_role if role else (has_given_place(), ~is_geotagged())),
        )
        .order_by(Photo.id)
    )
    return [
        GeotaggedPhoto(
            row[0],
            PhotoLocation(*row[1:4]),
            row[4],
            row[5],
            place_is_estimated=bool(row[6]) and row[6]["probability"] is not None,
            denied=None if role else CandidateLevel(**row[6]["denied"]),
        )
        for row in photos
        if role or "denied" in row[6]  # or else its given place was taken away since
    ]


MAX_READ_ATTEMPTS = 2
WITH_PLACE = PhotoFilter(has_place=True)

UNKNOWN_LOCATION = PhotoLocation(None, None, None)

LocatedRanking = list[tuple[SearchHit, PhotoLocation]]


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
    _supports: dict[frozenset[UUID], float | None] = field(default_factory=dict)
    """match support of the pairs of photos that were compared"""

    def match(self, photo_id: UUID, others: Sequence[UUID]) -> list[float | None]:
        """Return the `match_support` of a photo with each of others, which are compared once.

        None where one of the two has no local features.
        """
        pairs = [frozenset((photo_id, other)) for other in others]
        new = [
            other for other, pair in zip(others, pairs, strict=True) if pair not in self._supports
        ]
        if new:
            with self.catalog.read() as session:
                rows = find_feature_rows(session, self.generation.id, [photo_id, *new])
            found: dict[UUID, PhotoMatches | None] = {}
            query = rows.pop(photo_id, None)
            if query is not None and rows:
                references = [
                    FeatureReference(object_key=key, row=row)
                    for key, row in (query, *rows.values())
                ]
                request = MatchRequest(query=references[0], candidates=tuple(references[1:]))
                found = dict(zip(rows, self.search.match(request).candidates, strict=False))
            for other in new:
                matches = found.get(other)
                self._supports[frozenset((photo_id, other))] = (
                    None if matches is None else match_support(matches.matches, matches.inliers)
                )
        return [self._supports[pair] for pair in pairs]

    def rank_similar(
        self,
        query: GeotaggedPhoto,
        k: int,
        photos: PhotoFilter = WITH_PLACE,
    ) -> LocatedRanking | None:
        """Return the k most similar geotagged database photos with their locations.

        The query photo is excluded, too.

        Returns:
            The ranking, best first; None if the query was deleted since.

        Raises:
            Conflict: `map_damaged`: a chunk can't be read.
            Unavailable: `search_incomplete`: rows are still to be written to the engine.
        """
        for attempt in range(1, MAX_READ_ATTEMPTS + 1):
            with self.catalog.read() as session:
                location = find_descriptor(session, self.generation.id, query.photo_id)
            if location is None:
                return None
            descriptor, chunk = location
            request = SearchRequest(
                generation_id=self.generation.id,
                object_key=chunk.object_key,
                row=descriptor.row,
                min_version=self.version,
                k=k,
                photos=photos,
                exclude=(query.photo_id,),
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
            if answer.filling:
                raise Unavailable(
                    "search_incomplete",
                    "Rows are still being written to the search engine: the results would cover "
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
