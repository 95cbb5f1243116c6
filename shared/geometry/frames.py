"""Frames: east-north-up on the ellipsoid, similarities that lead into it, and headings.

`shared.geodesy` has distances on the sphere; here a metre is one on the ellipsoid WGS 84.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from shared.errors import Unprocessable
from shared.geometry.cameras import Floats

MIN_PHOTOS = 3
MIN_SPREAD = 0.02
"""Photos that extend less across their line, as a share of that along it, are on a line"""
MIN_AGREEING_SHARE = 0.75
"""of the photos with coordinates; where fewer agree, the model is bent or folded"""
GPS_SIGMA_M = 5.0
"""Expected standard deviation of coordinates in each direction, of a phone in a street"""
ROLL_SIGMA = math.radians(5)
"""Of upright photos: how far their cameras are turned about the direction in which they look"""
PITCH_SIGMA = math.radians(15)
"""Of all photos together: how far they look upwards or downwards in the mean"""
UNKNOWN_ALTITUDE_SIGMA_M = 10.0
"""Of a photo without an altitude, which is taken to be as high as the others"""
MAX_TYPICAL_ERROR = 4.0
"""Median distance to the coordinates in expected standard deviations"""
MAX_SCALE_SIGMA = 0.3
"""of ln(scale)"""
SAMPLES = 300
ITERATIONS = 30
INLIER_SIGMAS = 3.0
MIN_NOISE = 0.02
"""Least noise of coordinates in expected standard deviations: 10 cm of those of a phone"""
PART = 10
"""Successive photos of a part of a model that may be turned against the others"""

FLU_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""From a camera's axes (right, down, forward) to a body's (forward, left, up)"""


@dataclass(frozen=True)
class EastNorthUp:
    """The plane that touches the ellipsoid WGS 84 at a point: x east, y north, z up, in metres.

    Coordinates pass through earth-centred ones, so poles and the antimeridian are no exception.
    """

    latitude: float
    """degrees"""
    longitude: float
    altitude_m: float = 0.0
    """above the ellipsoid"""

    @cached_property
    def axes(self) -> Floats:
        """(3, 3): rows east, north and up in earth-centred axes."""
        phi, lam = math.radians(self.latitude), math.radians(self.longitude)
        east = [-math.sin(lam), math.cos(lam), 0.0]
        up = [math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)]
        return np.array([east, np.cross(up, east), up])

    def from_geographic(self, latitudes: Any, longitudes: Any, altitudes_m: Any) -> Floats:
        """Return the (n, 3) metres of (n,) degrees, degrees and metres."""
        from pymap3d import geodetic2enu

        places = (np.asarray(values, float) for values in (latitudes, longitudes, altitudes_m))
        return np.stack(geodetic2enu(*places, *self._point), axis=-1)

    def to_geographic(self, metres: Floats) -> EastNorthUp:
        """Return the point (3,) with the plane that touches the ellipsoid there."""
        from pymap3d import enu2geodetic

        return EastNorthUp(*map(float, enu2geodetic(*metres, *self._point)))

    @property
    def _point(self) -> tuple[float, float, float]:
        return self.latitude, self.longitude, self.altitude_m


@dataclass(frozen=True)
class Similarity:
    """Leads from the frame of a component to east-north-up: scale * rotation @ X + translation."""

    scale: float
    """metres in a unit of the component"""
    rotation: Floats
    """(3, 3)"""
    translation: Floats
    """(3,) metres"""
    covariance: Floats
    """(7, 7) of a turn in east-north-up (3, radians), a shift (3, metres) and ln(scale): what is
    applied to the turned and scaled points relative to `pivot`"""
    pivot: Floats
    """(3,) metres: the middle of the photos, about which the similarity is turned and scaled"""
    drift_m: float = 0.0
    """standard deviation of what no similarity explains, because the model or the coordinates are
    bent"""
    drift_radians: float = 0.0
    """that of the turn about the vertical which this bending gives to a part of the model"""
    knows_altitude: bool = True

    def apply(self, points: Floats) -> Floats:
        """Return (n, 3) or (3,) points of the component in east-north-up, metres."""
        moved: Floats = self.scale * points @ self.rotation.T + self.translation
        return moved

    def position_covariance(self, point: Floats) -> Floats:
        """Return the (3, 3) covariance, in square metres, of a point (3,) of the component.

        It is that of the similarity alone; the drift counts in each direction.
        """
        jacobian = _similarity_jacobian(self.apply(point)[None] - self.pivot)[0]
        covariance: Floats = jacobian @ self.covariance @ jacobian.T + np.eye(3) * self.drift_m**2
        return covariance

    def as_json(self) -> dict[str, Any]:
        """Return what `from_json` reads."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> Self:
        """Return the similarity of `as_json`."""
        read: dict[str, Any] = {
            name: np.array(item, float) if isinstance(item, list) else item
            for name, item in value.items()
        }
        return cls(**read)


@dataclass(frozen=True)
class Alignment:
    """A component in a plane at the middle of its photos' coordinates."""

    origin: EastNorthUp
    similarity: Similarity
    rms_m: float
    """of the horizontal distances between the photos that agree and their coordinates"""
    residuals_m: Floats
    """(n,) horizontal distance of each photo with coordinates; NaN without"""
    is_inlier: NDArray[np.bool_]
    """(n,) photos whose coordinates agree with most others"""
    is_on_line: bool = False
    """whether photos and coordinates are on a line, about which only upright cameras settle the
    turn"""


def align(
    centres: Floats,
    rotations: Sequence[Floats],
    latitudes: Floats,
    longitudes: Floats,
    altitudes_m: Floats,
    sigmas_m: Floats,
) -> Alignment:
    """Align a component with its photos' coordinates; Unprocessable (`not_aligned`) says why not.

    The similarity minimises the squared distances over `sigmas_m`, each at most INLIER_SIGMAS of
    the noise that the photos show, and the squared angles by which cameras lean to a side over
    ROLL_SIGMA: photos are upright. Its covariance has the size that the residuals show. Errors of
    neighbours that are alike, because GPS is off by the same for minutes or the model is bent,
    enlarge it.

    Args:
        centres: (n, 3) positions in the component, in the order in which they were taken.
        rotations: of each photo (3, 3), from the component to its camera's axes.
        latitudes, longitudes: (n,) degrees; NaN without coordinates.
        altitudes_m: (n,) metres; NaN where unknown.
        sigmas_m: (n,) expected standard deviation of the coordinates in each direction.
    """
    known = np.flatnonzero(np.isfinite(latitudes) & np.isfinite(longitudes))
    if len(known) < MIN_PHOTOS:
        raise Unprocessable(
            "not_aligned",
            f"{len(known)} of its photos have coordinates, and {MIN_PHOTOS} are needed.",
        )
    altitudes = altitudes_m[known]
    knows_altitude = bool(np.isfinite(altitudes).sum() >= MIN_PHOTOS)
    middle = float(np.nanmedian(altitudes)) if knows_altitude else 0.0
    origin = plane_at(latitudes[known], longitudes[known], middle)
    is_high = np.isfinite(altitudes) & knows_altitude
    targets = origin.from_geographic(
        latitudes[known], longitudes[known], np.where(is_high, altitudes, middle)
    )
    sigmas = np.repeat(sigmas_m[known, None], 3, axis=1)
    sigmas[~is_high, 2] = np.hypot(sigmas[~is_high, 2], UNKNOWN_ALTITUDE_SIGMA_M)
    points = centres[known]
    similarity, is_near = fit_similarity(
        points, targets, [rotations[i] for i in known.tolist()], sigmas, knows_altitude
    )
    residuals = targets - similarity.apply(points)
    distances = np.full(len(centres), np.nan)
    distances[known] = np.linalg.norm(residuals[:, :2], axis=1)
    typical = float(np.median(distances[known] / sigmas_m[known]))
    spread = float(np.median(np.linalg.norm((targets - np.median(targets, axis=0))[:, :2], axis=1)))
    middle_distance = float(np.nanmedian(distances))
    scatters = spread > 2 * np.median(sigmas_m[known]) and middle_distance > spread / 2
    if typical > MAX_TYPICAL_ERROR or scatters:
        raise Unprocessable(
            "not_aligned",
            f"Half of its photos are {middle_distance:.0f} m or more from their coordinates: these "
            "or the reconstruction are wrong.",
        )
    if similarity.covariance[6, 6] > MAX_SCALE_SIGMA**2:
        raise Unprocessable(
            "not_aligned",
            "Its photos are too close to each other for the errors of their coordinates.",
        )
    agrees = np.zeros(len(centres), dtype=bool)
    agrees[known] = is_near
    near = int(np.sum(distances[known] <= INLIER_SIGMAS * sigmas_m[known]))
    if max(near, agrees.sum()) < MIN_AGREEING_SHARE * len(known):
        raise Unprocessable(
            "not_aligned",
            f"Only {near} of {len(known)} photos agree with their coordinates: the reconstruction "
            "is bent, or many coordinates are wrong.",
        )
    rms = float(np.sqrt(np.mean(distances[agrees] ** 2)))
    is_on_line = _is_on_line(points) or _is_on_line(targets[:, :2])
    return Alignment(origin, similarity, rms, distances, agrees, is_on_line)


def align_at(
    origin: EastNorthUp, centres: Floats, latitudes: Floats, longitudes: Floats
) -> Alignment:
    """Return the alignment of a component whose frame is the plane at the origin.

    Coordinates of photos, (n,) degrees, NaN without, are only compared with it.
    """
    own = origin.from_geographic(latitudes, longitudes, np.full(len(centres), origin.altitude_m))
    distances = np.linalg.norm((own - centres)[:, :2], axis=1)
    agrees = distances <= INLIER_SIGMAS * GPS_SIGMA_M
    rms = float(np.sqrt(np.mean(distances[agrees] ** 2))) if agrees.any() else 0.0
    unmoved = Similarity(1.0, np.eye(3), np.zeros(3), np.zeros((7, 7)), centres.mean(axis=0))
    return Alignment(origin, unmoved, rms, distances, agrees)


def fit_similarity(
    points: Floats,
    targets: Floats,
    rotations: Sequence[Floats],
    sigmas: Floats,
    knows_altitude: bool,
) -> tuple[Similarity, NDArray[np.bool_]]:
    """Return the similarity of `align`, and which photos agree with it.

    Args:
        points: (n, 3) positions in the component, in the order in which they were taken.
        targets: (n, 3) metres in east-north-up.
        rotations: of each photo (3, 3), from the component to its camera's axes.
        sigmas: (n, 3) metres, expected standard deviations of the targets.
    """
    for what, places in (("coordinates", targets[:, :2]), ("reconstructed positions", points)):
        if np.ptp(places, axis=0).max() <= np.abs(places).max() * 1e-9:
            raise Unprocessable("not_aligned", f"The {what} of its photos are all the same.")
    axes = np.array(rotations)
    on_line = _is_on_line(points) or _is_on_line(targets[:, :2])
    level = _level(axes) if on_line else None
    start = _robust_start(points, targets, sigmas, level)
    return _refine(start, points, targets, sigmas, axes, knows_altitude)


def _is_on_line(places: Floats) -> bool:
    extents = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(extents[1] <= MIN_SPREAD * extents[0])


def _level(axes: Floats) -> Floats:
    """Return the (3, 3) rotation that leads from a component to a frame in which z is up.

    Up is where the cameras' right sides (axes[:, 0]) have no part, and their lower edges least.
    """
    rights, downs = axes[:, 0], axes[:, 1]
    _, vectors = np.linalg.eigh(rights.T @ rights - 0.1 * downs.T @ downs)
    up = vectors[:, 0] * (-1 if float(np.sum(downs @ vectors[:, 0])) > 0 else 1)
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    east /= np.linalg.norm(east)
    return np.array([east, np.cross(up, east), up])


def plane_at(latitudes: Floats, longitudes: Floats, altitude_m: float) -> EastNorthUp:
    """Return the plane at the middle of the places, also around a pole or the antimeridian."""
    from pymap3d import ecef2geodetic, geodetic2ecef

    earth_centred = geodetic2ecef(latitudes, longitudes, np.zeros(len(latitudes)))
    latitude, longitude, _ = ecef2geodetic(*np.median(earth_centred, axis=1))
    return EastNorthUp(float(latitude), float(longitude), altitude_m)


def umeyama(points: Floats, targets: Floats, weights: Floats) -> tuple[float, Floats, Floats]:
    """Return scale, rotation and translation of the weighted similarity (Umeyama, PAMI 1991)."""
    weights = weights / weights.sum()
    middle, target_middle = weights @ points, weights @ targets
    centred, target_centred = points - middle, targets - target_middle
    u, values, vt = np.linalg.svd((target_centred * weights[:, None]).T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0])
    rotation = u * signs @ vt
    variance = float(weights @ np.sum(centred**2, axis=1))
    scale = float(values @ signs) / max(variance, 1e-300)
    return scale, rotation, target_middle - scale * rotation @ middle


def _robust_start(
    points: Floats, targets: Floats, sigmas: Floats, level: Floats | None
) -> Similarity:
    """Return the similarity of a few photos with the least median error (LMedS).

    Args:
        level: of points on a line: the rotation to a frame in which z is up, about which the
            similarity turns. Otherwise three photos determine the turn.
    """
    rng = np.random.default_rng(0)
    weights = 1 / sigmas[:, 0] ** 2
    best, least = None, math.inf
    for number in range(SAMPLES + 1):
        rows = np.arange(len(points)) if not number else rng.choice(len(points), 3, replace=False)
        if level is None:
            fitted = umeyama(points[rows], targets[rows], weights[rows])
        else:
            fitted = _umeyama_level(points[rows] @ level.T, targets[rows], weights[rows])
            fitted = fitted[0], fitted[1] @ level, fitted[2]
        scale, rotation, translation = fitted
        if not scale > 0:
            continue
        errors = (scale * points @ rotation.T + translation - targets) / sigmas
        error = float(np.median(np.sum(errors**2, axis=1)))
        if error < least:
            best, least = fitted, error
    assert best is not None  # scale is 0 only of coinciding points
    return Similarity(*best, np.zeros((7, 7)), targets.mean(axis=0))


def _umeyama_level(
    points: Floats, targets: Floats, weights: Floats
) -> tuple[float, Floats, Floats]:
    """Return the weighted similarity that turns about z only, as `umeyama`."""
    weights = weights / weights.sum()
    middle, target_middle = weights @ points, weights @ targets
    plane, target_plane = (
        (places[:, 0] + 1j * places[:, 1]) for places in (points - middle, targets - target_middle)
    )
    square = float(weights @ np.abs(plane) ** 2)
    factor = complex((weights * plane.conj()) @ target_plane) / max(square, 1e-300)
    rotation = rotation_of_vector(np.array([0.0, 0.0, np.angle(factor)]))
    return abs(factor), rotation, target_middle - abs(factor) * rotation @ middle


def _refine(
    start: Similarity,
    points: Floats,
    targets: Floats,
    sigmas: Floats,
    axes: Floats,
    knows_altitude: bool,
) -> tuple[Similarity, NDArray[np.bool_]]:
    """Return the refined similarity with its covariance, and which photos agree with it."""
    scale, rotation, translation = start.scale, start.rotation, start.translation
    for _ in range(ITERATIONS):
        moved = scale * points @ rotation.T + translation
        pivot = moved.mean(axis=0)
        errors = (targets - moved) / sigmas
        distances = np.linalg.norm(errors[:, :2], axis=1)
        # Rayleigh: the median of two dimensions is 1.1774 standard deviations.
        noise = max(float(np.median(distances)) / 1.1774, MIN_NOISE)
        is_inlier = distances <= INLIER_SIGMAS * noise
        jacobian = _similarity_jacobian(moved - pivot) / sigmas[:, :, None]
        jacobian, errors = jacobian[is_inlier] / noise, errors[is_inlier] / noise
        # The height of a photo's right side, z, is 0; a turn t changes it by (t x right) . z.
        leaning = axes[:, 0] @ rotation.T
        roll_jacobian = _height_jacobian(leaning)
        roll_weights = 1 / (ROLL_SIGMA * (1 + (leaning[:, 2] / ROLL_SIGMA) ** 2))
        looking = (axes[:, 2] @ rotation.T).mean(axis=0, keepdims=True)
        rows = np.concatenate(
            [
                jacobian.reshape(-1, 7),
                roll_jacobian * roll_weights[:, None],
                _height_jacobian(looking) / PITCH_SIGMA,
            ]
        )
        values = np.concatenate(
            [errors.ravel(), -leaning[:, 2] * roll_weights, -looking[:, 2] / PITCH_SIGMA]
        )
        normal = rows.T @ rows + 1e-12 * np.eye(7)
        step = np.linalg.solve(normal, rows.T @ values)
        turn, factor = rotation_of_vector(step[:3]), math.exp(step[6])
        translation = factor * turn @ (translation - pivot) + pivot + step[3:6]
        rotation, scale = turn @ rotation, scale * factor
        if np.abs(step).max() < 1e-9:
            break
    moved = scale * points @ rotation.T + translation
    residuals = (targets - moved)[is_inlier, :2]
    alike = _lag1_autocorrelation(residuals)
    # Independent errors are alike by chance: their square correlation is 1 / size in the mean.
    bent = math.sqrt(max(0.0, alike**2 - 1 / residuals.size))
    variance = float(np.mean(residuals**2))
    # Turn, shift and scale fit four degrees of freedom of the noise.
    unfitted = residuals.size / max(1, residuals.size - 4)
    found = Similarity(
        scale,
        rotation,
        translation,
        np.linalg.inv(normal) * (unfitted * (1 + alike) / (1 - alike)),
        moved.mean(axis=0),
        math.sqrt(variance * bent),
        _rotation_deviation(moved[is_inlier, :2], residuals, variance * (1 - alike))
        if bent
        else 0.0,
        knows_altitude,
    )
    return found, is_inlier


def _rotation_deviation(positions: Floats, residuals: Floats, variance: float) -> float:
    """Return the standard deviation of the turns that fit the residuals of PART successive photos.

    `variance` is that of residuals which are not alike, and turns parts as well.
    """
    squares, expected = [], []
    for start in range(0, len(positions) - PART + 1, PART):
        part = positions[start : start + PART] - positions[start : start + PART].mean(axis=0)
        errors = residuals[start : start + PART]
        extent = float(np.sum(part**2))
        if extent > 0:
            turn = float(np.sum(part[:, 0] * errors[:, 1] - part[:, 1] * errors[:, 0])) / extent
            squares.append(turn**2)
            expected.append(variance / extent)
    return math.sqrt(max(0.0, float(np.mean(squares) - np.mean(expected)))) if squares else 0.0


def _lag1_autocorrelation(residuals: Floats) -> float:
    """Return the correlation of (n, 2) residuals with their successors, from 0 to 0.95."""
    if len(residuals) < 2 * MIN_PHOTOS or not (square := float(np.mean(residuals**2))):
        return 0.0
    return min(0.95, max(0.0, float(np.mean(residuals[1:] * residuals[:-1])) / square))


def _height_jacobian(directions: Floats) -> Floats:
    """Return the (n, 7) derivatives of the heights z of directions (n, 3)."""
    jacobian = np.zeros((len(directions), 7))
    jacobian[:, 0], jacobian[:, 1] = directions[:, 1], -directions[:, 0]
    return jacobian


def _similarity_jacobian(offsets: Floats) -> Floats:
    """Return the (n, 3, 7) derivatives of points, given relative to the pivot."""
    jacobian = np.zeros((len(offsets), 3, 7))
    jacobian[:, :, :3] = -cross_matrices(offsets)
    jacobian[:, :, 3:6] = np.eye(3)
    jacobian[:, :, 6] = offsets
    return jacobian


def cross_matrices(vectors: Floats) -> Floats:
    """Return the (n, 3, 3) matrices [v] of (n, 3) vectors, [v] @ w = v x w."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -z, y, -x
    return matrices - matrices.transpose(0, 2, 1)


def rotation_of_vector(vector: Floats) -> Floats:
    """Return the (3, 3) rotation about a vector (3,) by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    cross = cross_matrices(np.asarray(vector)[None])[0]
    sine = np.sinc(angle / math.pi)
    versine = 0.5 * np.sinc(angle / (2 * math.pi)) ** 2
    rotation: Floats = np.eye(3) + sine * cross + versine * cross @ cross
    return rotation


@dataclass(frozen=True, slots=True)
class Attitude:
    """Where a camera looks, in degrees."""

    heading: float
    """clockwise from north, from 0 to 360"""
    pitch: float
    """upwards, from -90 to 90"""
    roll: float
    """clockwise about the direction of view, from -180 to 180"""


def attitude_of(rotation: Floats) -> Attitude:
    """Return the attitude of a camera from its (3, 3) rotation from east-north-up to its axes.

    Rolling clockwise turns the right side down. A camera that looks straight up or down has the
    heading of its upper or lower edge, and no roll.
    """
    right, _, forward = rotation
    pitch = math.asin(float(np.clip(forward[2], -1, 1)))
    if math.hypot(forward[0], forward[1]) < 1e-9:
        heading, roll = math.atan2(-right[1], right[0]), 0.0
    else:
        heading = math.atan2(forward[0], forward[1])
        level = np.array([math.cos(heading), -math.sin(heading), 0.0])
        roll = math.atan2(float(level @ rotation[1]) * -1, float(level @ right))
    return Attitude(math.degrees(heading) % 360, math.degrees(pitch), math.degrees(roll))


def geopose_rotation(rotation: Floats) -> Floats:
    """Return the (3, 3) rotation of OGC GeoPose 1.0 (21-056r11), from the inner to the outer frame.

    The outer frame is east-north-up at the camera. The standard leaves the inner one to the object;
    here it is the camera's forward (x), left (y) and up (z), as in ROS (REP 103). So the identity
    looks east.

    Args:
        rotation: (3, 3) from east-north-up to the camera's axes.
    """
    found: Floats = rotation.T @ FLU_FROM_CAMERA.T
    return found
