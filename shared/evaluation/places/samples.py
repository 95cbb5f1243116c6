"""Samples of a map's own photos, and impostors, for its place model.

A photo is searched without itself. If its place was also photographed in another session, all
photos of its own session are left out; else photos taken within `BURST_PERIOD` of it. Where the
capture times are not known, only the photo itself and its copies are: its neighbours in the same
walk stay in the map, which flatters the result.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial
from statistics import median

import numpy as np
from numpy.typing import NDArray

from shared.evaluation.places.evidence import (
    DIFFERENT_PLACE_M,
    EVIDENCE_DEPTH,
    MATCHED_PHOTOS,
    PhotoLocation,
    RankedPhoto,
    are_matched,
)
from shared.evaluation.places.fit import PlaceSample
from shared.evaluation.places.levels import (
    CandidateLevel,
    LevelScheme,
    candidate_levels,
    ranking_spread,
)
from shared.geodesy import distances_m
from shared.place_paths import label_levels

# A photo taken less than this before or after another one belongs to the same session.
SAME_SESSION_PERIOD = timedelta(hours=12)
BURST_PERIOD = timedelta(seconds=1)
MAX_COPIES = 3  # of a photo, which are the first of its ranking
OWN_PHOTO_RULE = (
    "without the photos of its session (12 h) where another session shows its place, else without "
    "those of the same second, and always without its copies"
)
"""what each of the map's own photos is searched without, in words"""

Indices = NDArray[np.int64]
IndexRanking = tuple[Indices, NDArray[np.float64]]
"""(k,) numbers of photos, best first, and their scores"""
RankOwnPhoto = Callable[[int], IndexRanking | None]
"""Ranks the photos of the map by their similarity to one of them, without it."""
MatchOwnPhoto = Callable[[int, Sequence[Hashable]], Sequence[float | None]]
"""Returns the `match_support` of a photo with each of others; None where they can't be compared."""


class OwnPhotoSampler:
    """Draws samples for a place model from photos of a map.

    Args:
        locations: The locations of the map's photos; those without a place are left out.
        position_radius_m: Radius of a place in metres.
        rank: Ranks these photos. Called once per photo.
        is_copy: Whether two photos are the same one, in other sizes or qualities; called where no
            capture times tell them apart.
    """

    def __init__(
        self,
        locations: Sequence[PhotoLocation],
        captured_at: Sequence[datetime | None],
        scheme: LevelScheme,
        position_radius_m: float,
        rank: RankOwnPhoto,
        is_copy: Callable[[int, int], bool] = lambda photo, other: False,
    ) -> None:
        self._locations = locations
        self._scheme = scheme
        self._radius_m = position_radius_m
        self._rank = rank
        self._is_copy = is_copy
        self._rankings: dict[int, IndexRanking | None] = {}
        self._known = np.array([spot.is_known for spot in locations], dtype=bool)
        # None becomes NaN.
        self._latitudes = np.array([spot.latitude for spot in locations], dtype=np.float64)
        self._longitudes = np.array([spot.longitude for spot in locations], dtype=np.float64)
        self._seconds = np.array([t and t.timestamp() for t in captured_at], dtype=np.float64)
        paths = [label_levels(spot.place, scheme.labels_are_paths) for spot in locations]
        depth = max(map(len, paths), default=0)
        self._labels = [
            np.array([path[i] if i < len(path) else None for path in paths], dtype=object)
            for i in range(depth)
        ]

    def ranking(self, photo: int) -> IndexRanking | None:
        """Return the ranking of a photo, which is searched only once."""
        if photo not in self._rankings:
            self._rankings[photo] = self._rank(photo)
        return self._rankings[photo]

    def spread(self, photos: Sequence[int]) -> float:
        """Return the median difference of the first and the last score of their rankings."""
        rankings = [
            self._ranked(r, self._visible(photo)) for photo in photos if (r := self.ranking(photo))
        ]
        return median([ranking_spread(ranking) for ranking in rankings] or [1.0])

    def samples(
        self, photos: Sequence[int], spread: float, match: MatchOwnPhoto | None = None
    ) -> Iterator[PlaceSample]:
        """Yield the samples of photos: each as it is, and as an impostor of each kind.

        With `match`, the samples have the features of matches; those whose
        first photos can't all be compared are left out.
        """
        for photo in photos:
            visible = self._visible(photo)
            is_alone = not (visible & self._at_place(photo)).any()
            for left_out, missing in self._kinds(photo):
                levels = self._levels(photo, visible & ~missing, spread, match)
                if levels:
                    right = [level.is_right(self._locations[photo]) for level in levels]
                    yield PlaceSample(photo, levels, right, left_out, is_alone)

    def neighbours(self, photo: int, visible: NDArray[np.bool_] | None = None) -> list[RankedPhoto]:
        """Return the ranking of a photo among the visible ones, by default all."""
        ranking = self.ranking(photo)
        if ranking is None:
            return []
        return self._ranked(ranking, self._known if visible is None else visible)

    def _levels(
        self,
        photo: int,
        visible: NDArray[np.bool_],
        spread: float,
        match: MatchOwnPhoto | None,
    ) -> list[CandidateLevel]:
        found = self.ranking(photo)
        if found is None:
            return []
        ranking = self._ranked(found, visible)
        if match is not None:
            ranking = attach_matches(ranking, partial(match, photo))
            if not are_matched(ranking):
                return []
        first = found[0][visible[found[0]]][:1]
        return candidate_levels(
            ranking,
            self.neighbours(int(first[0]), visible) if len(first) else [],
            self._scheme,
            spread,
            self._radius_m,
        )

    def _ranked(self, ranking: IndexRanking, visible: NDArray[np.bool_]) -> list[RankedPhoto]:
        shown = np.flatnonzero(visible[ranking[0]])[:EVIDENCE_DEPTH]
        photos, scores = ranking[0][shown].tolist(), ranking[1][shown].tolist()
        return [
            RankedPhoto(score, self._locations[photo], photo)
            for photo, score in zip(photos, scores, strict=True)
        ]

    def _visible(self, photo: int) -> NDArray[np.bool_]:
        """Return the (n,) mask of the photos that a sample may find."""
        visible = self._known.copy()
        visible[photo] = False
        apart = np.abs(self._seconds - self._seconds[photo])
        same_session = apart < SAME_SESSION_PERIOD.total_seconds()
        if (self._at_place(photo) & ~same_session & ~np.isnan(apart)).any():
            left_out = same_session
        else:
            left_out = apart <= BURST_PERIOD.total_seconds()
        visible[left_out] = False
        found, _ = self.ranking(photo) or (np.zeros(0, dtype=np.int64), None)
        for other in found[np.isnan(apart[found])][:MAX_COPIES].tolist():
            visible[other] &= not self._is_copy(photo, other)
        return visible

    def _at_place(self, photo: int) -> NDArray[np.bool_]:
        near: NDArray[np.bool_] = self._away_m(photo) <= self._radius_m
        if self._labels and self._labels[0][photo] is not None:
            near |= self._labels[0] == self._labels[0][photo]
        return near

    def _kinds(self, photo: int) -> Iterator[tuple[str | None, NDArray[np.bool_]]]:
        """Yield what is left out of the map, with the (n,) mask of the photos that are missing."""
        yield None, np.zeros(len(self._locations), dtype=bool)
        if not self._scheme.labels_are_paths and self._locations[photo].latitude is not None:
            missing = self._away_m(photo) <= DIFFERENT_PLACE_M
            yield "position", missing | self._at_place(photo)
            return
        for position, labels in enumerate(self._labels):
            if labels[photo] is not None and (labels != labels[photo]).any():
                yield f"level {position}", labels == labels[photo]

    def _away_m(self, photo: int) -> NDArray[np.float64]:
        spot = self._latitudes[photo], self._longitudes[photo]
        away = distances_m(*spot, self._latitudes, self._longitudes)
        return np.where(np.isnan(away), np.inf, away)


def attach_matches(
    ranking: Sequence[RankedPhoto], match: Callable[[Sequence[Hashable]], Sequence[float | None]]
) -> list[RankedPhoto]:
    """Return a ranking whose first MATCHED_PHOTOS have their match support."""
    support = match([r.photo for r in ranking[:MATCHED_PHOTOS]])
    first = [replace(r, support=s) for r, s in zip(ranking, support, strict=False)]
    return [*first, *ranking[len(first) :]]
