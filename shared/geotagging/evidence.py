"""What one source says about where a photo was taken, as a mixture of Gaussians on a plane.

*Picture*: the place model's probabilities of its circles (`shared/evaluation/places/probability`),
and the other photos that look similar, by the power law of `shared/tracks/evidence`. A pose of the
photo, if it has one, is in place of both: only WRONG_POSE_SHARE of the density is theirs then.

*Neighbours in time* and *GPX*: positions of known times before and after the photo, of the same
camera or of a track. In between the position is interpolated. Between two known times the camera
moved no faster than the motion model allows, so at dt seconds from a known position the standard
deviation is that position's accuracy plus half the maximum speed times dt, as in the kernel of
`shared/tracks/filter`. The two sides are combined by their inverse variances. If the camera moved
faster between both, this speed counts. OUTLIER_SHARE of such positions are wrong: a clock that was
set wrong, a photo that another person took, a wrong fix.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left, insort
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import TypeVar

import numpy as np

from shared.geodesy import distance_m
from shared.geotagging.mixture import Mixture, Plane
from shared.tracks.evidence import rank_shares

SPACING_M = 12.0
"""Standard deviation between a photo and the most similar one of the map"""
FIX_ACCURACY_M = 12.0
"""Standard deviation of a position in a photo or a GPX track"""
OUTLIER_SHARE = 0.02
SAME_CAMERA_SHARE = 0.5
"""Of two photos by one model, of which nothing says that one camera took both: that it did"""
COMPANION_SIGMA_M = 500.0
"""Standard deviation between the cameras of people whose photos are in one folder"""
MAX_SKIPPED_NUMBERS = 20
"""Between two file names of one series: photos that were deleted or lie elsewhere"""
COUNTER = re.compile(r"(.*?)(\d{1,7})((?: \(\d+\))?\.[^.]*)")
DATE_DIGITS = 8  # in a row: a name made of the time says nothing about the camera
WRONG_POSE_SHARE = 0.02
"""Of poses, at most: 1 % of the accepted ones are wrong, and a radius may be too small"""
RAYLEIGH_68 = 1.51
"""Radius with 68 % of a Gaussian in the plane, in standard deviations"""
MAX_SIGMA_M = 1000.0
"""Known times from which the camera may have moved farther say nothing"""


@dataclass(frozen=True, slots=True)
class SimilarPosition:
    """Position of a photo of the map that looks similar."""

    latitude: float
    longitude: float
    score: float
    name: str


@dataclass(frozen=True, slots=True)
class ProbableCircle:
    """A level of an estimate: a circle, and the probability that it contains the position."""

    latitude: float
    longitude: float
    radius_m: float
    probability: float


@dataclass(frozen=True, slots=True)
class PosePosition:
    """Pose of a photo in the reconstruction of a map."""

    latitude: float
    longitude: float
    radius_68_m: float
    heading: float
    """degrees clockwise from north"""


@dataclass(frozen=True, slots=True)
class PictureEvidence:
    """What a search of the map says about a photo."""

    similar: Sequence[SimilarPosition]
    """those with coordinates"""
    circles: Sequence[ProbableCircle]
    """around the estimated position, finest first; empty without an estimate"""
    not_in_map: float
    """probability that the map has no photo of the place"""
    photo_count: int
    """number of photos of the map"""
    pose: PosePosition | None = None
    headline: str = ""
    """of the estimate; the reason if nothing is proposed"""


@dataclass(frozen=True, slots=True)
class KnownPosition:
    """Where a camera or a traveller was at a time."""

    time: datetime
    latitude: float
    longitude: float
    name: str = ""
    """of the photo; empty for a point of a GPX track"""


@dataclass(frozen=True, slots=True)
class DatedPhoto:
    """A photo with what its file says about when, where and by which camera it was taken."""

    name: str
    time: datetime | None
    """UTC, or the camera's clock as if it were UTC"""
    time_zone_is_known: bool
    camera: str | None
    latitude: float | None
    longitude: float | None
    clock_offset: timedelta | None = None
    """of the camera's clock from UTC, if it is known"""
    camera_is_unique: bool = False
    """`camera` contains a serial number or an owner"""


Dated = TypeVar("Dated", bound=DatedPhoto)


@dataclass(frozen=True, slots=True)
class InterpolatedPosition:
    """Where a photo was taken according to known positions before and after it."""

    latitude: float
    longitude: float
    sigma_m: float
    """standard deviation in each direction"""
    nearest: KnownPosition
    """in time"""
    seconds: float
    """from the nearest to the photo; negative if the photo was taken before"""
    same_camera: bool = True
    """whether something says that the same camera took them, not only one of the same model"""


def picture_mixture(evidence: PictureEvidence, plane: Plane) -> Mixture:
    """Return the density of the position according to the picture."""
    pose, similar = evidence.pose, _similarity_mixture(evidence, plane)
    if pose is None:
        return similar
    others = zip(similar.means.tolist(), similar.sigmas.tolist(), similar.weights, strict=True)
    at = plane.to_metres(pose.latitude, pose.longitude)
    components = [(at, pose.radius_68_m / RAYLEIGH_68, 1 - WRONG_POSE_SHARE)]
    components += [(mean, sigma, WRONG_POSE_SHARE * weight) for mean, sigma, weight in others]
    return Mixture.of(components, WRONG_POSE_SHARE * similar.uniform)


def _similarity_mixture(evidence: PictureEvidence, plane: Plane) -> Mixture:
    """Return the density of the position according to similar photos and the estimate.

    The probability that lies between two circles goes to the similar photos there, and what these
    do not explain to a Gaussian that has most of its weight within the outer circle. The photos
    outside of all circles share what is left with the photos of the map that were not found.
    """
    # Clients of the API may have another order, such as that of the match probability.
    similar = sorted(evidence.similar, key=lambda photo: photo.score, reverse=True)
    scores = np.array([photo.score for photo in similar], dtype=np.float64)
    shares, rest = rank_shares(scores, max(evidence.photo_count, len(scores)))
    at = [plane.to_metres(photo.latitude, photo.longitude) for photo in similar]
    if not evidence.circles:
        known = 1 - evidence.not_in_map
        components = [
            (mean, SPACING_M, known * share)
            for mean, share in zip(at, shares.tolist(), strict=True)
        ]
        return Mixture.of(components, evidence.not_in_map + known * rest)
    centre = plane.to_metres(evidence.circles[0].latitude, evidence.circles[0].longitude)
    away = np.array([math.dist(mean, centre) for mean in at], dtype=np.float64)
    finest = evidence.circles[0]
    outside = away > finest.radius_m
    others = max(0.0, 1 - finest.probability - evidence.not_in_map)
    weights = others * shares / max(float(shares[outside].sum()) + rest, 1e-12) * outside
    components = [(centre, finest.radius_m / 2, finest.probability)]
    components += [
        (mean, SPACING_M, weight) for mean, weight in zip(at, weights.tolist(), strict=True)
    ]
    for inner, outer in zip(evidence.circles, evidence.circles[1:], strict=False):
        ring = (away > inner.radius_m) & (away <= outer.radius_m)
        missing = outer.probability - inner.probability - float(weights[ring].sum())
        components.append((centre, outer.radius_m / 2, max(0.0, missing)))
    explained = sum(weight for _, _, weight in components)
    return Mixture.of(components, max(evidence.not_in_map, 1 - explained))


def interpolate_position(
    known: Sequence[KnownPosition], time: datetime, max_speed_mps: float
) -> InterpolatedPosition | None:
    """Interpolate the position at a time.

    Args:
        known: In the order of their times.
        time: Comparable with the times of `known`.

    Returns:
        None if no known time is near enough to say anything (MAX_SIGMA_M).
    """
    index = bisect_left(known, time, key=lambda position: position.time)
    sides = [*known[max(index - 1, 0) : index], *known[index : index + 1]]
    if not sides:
        return None
    gaps = [abs((time - side.time).total_seconds()) for side in sides]
    speed = max_speed_mps
    share = 0.0
    if len(sides) == 2 and sum(gaps) > 0:
        moved = distance_m(
            sides[0].latitude, sides[0].longitude, sides[1].latitude, sides[1].longitude
        )
        speed = max(speed, moved / sum(gaps))
        share = gaps[0] / sum(gaps)
    sigmas = [FIX_ACCURACY_M + speed * gap / 2 for gap in gaps]
    sigma = sum(sigma**-2 for sigma in sigmas) ** -0.5
    if sigma > MAX_SIGMA_M:
        return None
    plane = Plane(sides[0].latitude, sides[0].longitude)
    east, north = plane.to_metres(sides[-1].latitude, sides[-1].longitude)
    nearest = sides[gaps.index(min(gaps))]
    return InterpolatedPosition(
        *plane.to_degrees(share * east, share * north),
        sigma,
        nearest,
        (time - nearest.time).total_seconds(),
    )


def add_time_zones(photos: Sequence[Dated]) -> list[Dated]:
    """Give clocks without a time zone that of the photo by the same camera that is nearest in time.

    Its zone is known by its tag, or because it has the time of the clock and that of the GPS.
    """
    zones: dict[str, list[tuple[datetime, timedelta]]] = {}
    for photo in photos:
        if photo.camera and photo.time and photo.clock_offset is not None:
            clock = photo.time + photo.clock_offset
            insort(zones.setdefault(photo.camera, []), (clock, photo.clock_offset))
    return [
        _with_nearest_zone(photo, zones[photo.camera])
        if photo.camera in zones and photo.time and not photo.time_zone_is_known
        else photo
        for photo in photos
    ]


def _with_nearest_zone(photo: Dated, zones: Sequence[tuple[datetime, timedelta]]) -> Dated:
    clock = photo.time
    assert clock is not None
    index = bisect_left(zones, clock, key=lambda each: each[0])
    _, offset = min(zones[max(index - 1, 0) : index + 1], key=lambda each: abs(each[0] - clock))
    return replace(photo, time=clock - offset, time_zone_is_known=True, clock_offset=offset)


class TimeNeighbours:
    """The photos with time and coordinates, by the camera whose times and way they show.

    The times of one camera can be compared without their time zone, but not with times in UTC.
    Photos by one model are of one camera if that has a serial number or an owner, or if their names
    are a series in the order of their times. Otherwise another phone may have taken them.

    Args:
        together: Whether the people with the cameras travelled together.
    """

    def __init__(self, photos: Sequence[DatedPhoto], together: bool) -> None:
        self._together = together
        self._series = _file_series(photos)
        self._known: dict[object, list[KnownPosition]] = {}
        for photo in photos:
            if photo.time is None or photo.latitude is None or photo.longitude is None:
                continue
            position = KnownPosition(photo.time, photo.latitude, photo.longitude, photo.name)
            for clock in {self._camera(photo), self._model(photo)} - {None}:
                known = self._known.setdefault(clock, [])
                insort(known, position, key=lambda each: each.time)

    def position_of(self, photo: DatedPhoto, max_speed_mps: float) -> InterpolatedPosition | None:
        """Interpolate the position of a photo without coordinates; None if nothing is known."""
        if photo.time is None:
            return None
        known = self._known.get(self._camera(photo), ())
        position = interpolate_position(known, photo.time, max_speed_mps)
        if position is not None:
            return position
        known = self._known.get(self._model(photo), ())
        position = interpolate_position(known, photo.time, max_speed_mps)
        return position and replace(position, same_camera=False)

    def why_unknown(self, photo: DatedPhoto, picture: PictureEvidence | None = None) -> str:
        """Say why no position is proposed for a photo."""
        if picture is not None and picture.headline:
            return picture.headline
        if photo.time is not None and not photo.time_zone_is_known:
            return "nothing is known about its place, and the time zone of its clock is missing"
        return "nothing is known about its place"

    def _camera(self, photo: DatedPhoto) -> object:
        """Return what photos of one camera have in common; None if that is unknown."""
        if self._together:
            return "", photo.time_zone_is_known
        if photo.camera_is_unique:
            return photo.camera, photo.time_zone_is_known
        return self._series.get(photo.name)

    def _model(self, photo: DatedPhoto) -> object:
        """Return what photos of one model have in common, unless they are of known cameras."""
        if self._together or photo.camera_is_unique or photo.camera is None:
            return None
        return photo.camera, photo.time_zone_is_known


def _file_series(photos: Sequence[DatedPhoto]) -> dict[str, object]:
    """Return the series by the name of the photo: numbers that grow with the times."""
    groups: dict[tuple[str, ...], list[tuple[int, datetime, str]]] = {}
    for photo in photos:
        folder, _, name = photo.name.rpartition("/")
        match = COUNTER.fullmatch(name)
        digits = re.findall(r"\d+", name)
        is_date = len(digits) > 1 and any(len(run) >= DATE_DIGITS for run in digits)
        if match and photo.time and photo.camera and not is_date:
            key = photo.camera, str(photo.time_zone_is_known), folder, match[1]
            groups.setdefault(key, []).append((int(match[2]), photo.time, photo.name))
    series: dict[str, object] = {}
    for group, members in groups.items():
        if len({each[:2] for each in members}) > len({number for number, *_ in members}):
            continue  # two cameras count the same numbers
        begin = last = min(members)
        for member in sorted(members):
            if member[0] - last[0] > MAX_SKIPPED_NUMBERS or member[1] < last[1]:
                begin = member
            series[member[2]] = (*group, begin[0])
            last = member
    return series


def position_mixture(position: InterpolatedPosition, plane: Plane) -> Mixture:
    """Return the density of the position according to positions of known times."""
    mean = plane.to_metres(position.latitude, position.longitude)
    components = [(mean, position.sigma_m, 1 - OUTLIER_SHARE)]
    if not position.same_camera:
        sigma = math.hypot(position.sigma_m, COMPANION_SIGMA_M)
        share = SAME_CAMERA_SHARE * (1 - OUTLIER_SHARE)
        components = [(mean, position.sigma_m, share), (mean, sigma, 1 - OUTLIER_SHARE - share)]
    return Mixture.of(components, OUTLIER_SHARE)
