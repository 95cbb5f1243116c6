"""Fusion of a picture, neighbours in time and a GPX track: mixtures of Gaussians, and proposals."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from shared.geodesy import distance_m
from shared.geotagging.evidence import (
    KnownPosition,
    PictureEvidence,
    PosePosition,
    ProbableCircle,
    SimilarPosition,
    interpolate_position,
    picture_mixture,
)
from shared.geotagging.fusion import Proposal, propose_position
from shared.geotagging.mixture import REGION_AREA_M2, Mixture, Plane

pytestmark = pytest.mark.numerics

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)
LATITUDE, LONGITUDE = 45.0691, 7.6853
PLANE = Plane(LATITUDE, LONGITUDE)
WALK_MPS = 3.0
RADIUS_M = 100.0


def known(seconds: float, east: float, north: float, name: str = "") -> KnownPosition:
    return KnownPosition(NOON + timedelta(seconds=seconds), *PLANE.to_degrees(east, north), name)


def picture(*similar: tuple[float, float, float], probability: float = 0.6) -> PictureEvidence:
    """Photos of a map of 1,000 at (east, north, score); the estimate is the first one."""
    photos = [
        SimilarPosition(*PLANE.to_degrees(east, north), score, f"{number}.jpg")
        for number, (east, north, score) in enumerate(similar)
    ]
    circles = [
        ProbableCircle(photos[0].latitude, photos[0].longitude, radius, probability + 0.02 * ring)
        for ring, radius in enumerate((25.0, 100.0, 500.0, 2000.0))
    ]
    return PictureEvidence(photos, circles, 0.02, 1000)


def proposed(
    of_picture: PictureEvidence | None,
    neighbours: list[KnownPosition] | None = None,
    track: list[KnownPosition] | None = None,
) -> Proposal:
    """The proposal for a photo at noon."""
    proposal = propose_position(
        of_picture,
        interpolate_position(neighbours or [], NOON, WALK_MPS),
        interpolate_position(track or [], NOON, WALK_MPS),
        RADIUS_M,
    )
    assert proposal is not None
    return proposal


def metres_from(proposal: Proposal, east: float, north: float) -> float:
    return distance_m(proposal.latitude, proposal.longitude, *PLANE.to_degrees(east, north))


def test_the_product_of_mixtures_is_the_product_of_their_densities() -> None:
    a = Mixture.of([((0.0, 0.0), 40.0, 0.5), ((300.0, 0.0), 20.0, 0.3)], 0.2)
    b = Mixture.of([((60.0, 30.0), 60.0, 0.9)], 0.1)
    product = a.times(b)
    assert product.uniform + product.weights.sum() == pytest.approx(1)

    def density(mixture: Mixture, point: tuple[float, float]) -> float:
        squares = ((mixture.means - np.array(point)) ** 2).sum(axis=1)
        variances = mixture.sigmas**2
        gaussians = mixture.weights * np.exp(-squares / (2 * variances)) / (2 * np.pi * variances)
        return float(gaussians.sum()) + mixture.uniform / REGION_AREA_M2

    points = [(0.0, 0.0), (60.0, 30.0), (300.0, 0.0), (-500.0, 200.0)]
    ratios = [density(product, p) / density(a, p) / density(b, p) for p in points]
    assert ratios == pytest.approx([ratios[0]] * 4, rel=1e-9)


def test_the_probability_of_a_circle_is_that_of_the_rayleigh_distribution() -> None:
    mixture = Mixture.of([((50.0, -20.0), 30.0, 0.8)], 0.2)
    centre, probability = mixture.best_circle(60.0)
    assert centre == pytest.approx((50, -20), abs=3)
    assert probability == pytest.approx(0.8 * (1 - math.exp(-(60**2) / (2 * 30**2))), abs=0.02)
    assert mixture.radius_m(centre, 0.68) == pytest.approx(30 * math.sqrt(-2 * math.log(0.32)), 0.1)


def test_a_plane_keeps_distances_across_the_antimeridian() -> None:
    plane = Plane(-17.0, 179.9995)
    east, north = plane.to_metres(-17.001, -179.9995)
    away = distance_m(-17.0, 179.9995, -17.001, -179.9995)
    assert math.hypot(east, north) == pytest.approx(away, rel=1e-3)
    assert plane.to_degrees(east, north) == pytest.approx((-17.001, -179.9995))


def test_a_picture_alone_is_as_probable_as_its_estimate() -> None:
    proposal = proposed(picture((0, 0, 0.9), (5, 0, 0.8), (900, 0, 0.5), probability=0.7))
    assert proposal.probability == pytest.approx(0.72, abs=0.02), "that of its 100 m"
    assert metres_from(proposal, 0, 0) < 5
    assert proposal.reason == "looks like 0.jpg"
    assert proposal.radius_m == RADIUS_M


def test_a_picture_of_another_place_than_the_maps_proposes_nothing() -> None:
    elsewhere = PictureEvidence(picture((0, 0, 0.9)).similar, [], 1.0, 1000)
    assert propose_position(elsewhere, None, None, RADIUS_M) is None


def test_similar_photos_count_by_their_scores_in_any_order() -> None:
    """The page orders matches by their probability."""
    similar = picture((0, 0, 0.9), (900, 0, 0.5), (1800, 0, 0.4)).similar
    by_score, reversed_ = (
        proposed(PictureEvidence(photos, [], 0.02, 1000)) for photos in (similar, similar[::-1])
    )
    assert metres_from(by_score, 0, 0) < 1
    assert metres_from(reversed_, 0, 0) < 1
    assert reversed_.probability == pytest.approx(by_score.probability)


def test_a_neighbour_in_time_decides_between_two_places_that_look_alike() -> None:
    alike = picture((0, 0, 0.80), (1500, 0, 0.79), (1510, 0, 0.78), (4000, 0, 0.4), probability=0.5)
    assert proposed(alike).probability < 0.6
    neighbours = [known(-60, 1530, 40, "before.jpg")]
    proposal = proposed(alike, neighbours)
    assert metres_from(proposal, 1505, 0) < 30
    assert proposal.probability > 0.9
    assert proposal.reason == "looks like 1.jpg; taken 60 s after before.jpg"


def test_a_picture_that_looks_like_elsewhere_is_named_and_lowers_the_probability() -> None:
    neighbours = [known(-10, 0, 0, "before.jpg"), known(10, 5, 0, "after.jpg")]
    alone = proposed(None, neighbours)
    contradicted = proposed(picture((1500, 0, 0.9), probability=0.9), neighbours)
    assert metres_from(contradicted, 0, 0) < 20
    assert contradicted.probability < alone.probability
    assert "another place" in contradicted.reason


def test_between_two_positions_the_photo_is_where_the_walk_was_at_that_time() -> None:
    sides = [known(-10, 0, 0), known(30, 40, 0)]
    proposal = proposed(None, None, sides)
    assert metres_from(proposal, 10, 0) < 3
    assert proposal.probability > 0.95
    assert proposal.reason == "GPX track, 10 s from its nearest point"


def test_a_photo_of_the_same_second_is_taken_at_the_same_time() -> None:
    proposal = proposed(None, [known(0, 0, 0, "other.jpg")])
    assert proposal.reason == "taken at the same time as other.jpg"


def test_the_farther_the_known_times_the_less_probable_is_the_position() -> None:
    probabilities = [
        proposed(None, [known(-seconds, 0, 0)]).probability for seconds in (5, 30, 90, 300)
    ]
    assert probabilities == sorted(probabilities, reverse=True)
    assert probabilities[0] > 0.95
    assert probabilities[-1] < 0.2
    assert interpolate_position([known(-3600, 0, 0)], NOON, WALK_MPS) is None


def test_a_camera_that_moved_faster_than_it_should_is_placed_less_precisely() -> None:
    by_train = interpolate_position([known(-30, 0, 0), known(30, 3000, 0)], NOON, WALK_MPS)
    on_foot = interpolate_position([known(-30, 0, 0), known(30, 30, 0)], NOON, WALK_MPS)
    assert by_train is not None
    assert on_foot is not None
    assert by_train.sigma_m > 10 * on_foot.sigma_m


def test_nothing_known_gives_no_proposal() -> None:
    empty = PictureEvidence([], [], 0.02, 0)
    assert propose_position(empty, None, None, RADIUS_M) is None
    assert propose_position(None, None, None, RADIUS_M) is None


def test_without_an_estimate_the_similar_photos_share_the_probability() -> None:
    evidence = PictureEvidence(picture((0, 0, 0.9), (800, 0, 0.5)).similar, [], 0.1, 1000)
    mixture = picture_mixture(evidence, PLANE)
    assert mixture.weights[0] > mixture.weights[1] > 0
    assert mixture.uniform > 0.1, "photos that were not found have a share, too"


def test_a_pose_gives_the_position_and_the_heading_unless_other_sources_contradict() -> None:
    at = PLANE.to_degrees(12.0, -9.0)
    pose = PosePosition(*at, radius_68_m=0.5, heading=338.0)
    posed = replace(picture((0, 0, 0.9), (400, 0, 0.8)), pose=pose)
    proposal = proposed(posed)
    assert metres_from(proposal, 12, -9) < 0.1
    assert proposal.heading == 338
    assert proposal.radius_68_m == pytest.approx(0.5, rel=0.2)
    assert proposal.probability > 0.97 > proposed(replace(posed, pose=None)).probability
    assert proposal.reason == "pose to 0.5 m"
    beside = [known(-5, 20, 0, "a.jpg"), known(5, 20, 0, "b.jpg")]
    both = proposed(posed, beside)
    assert metres_from(both, 12, -9) < 0.2
    assert both.reason == "pose to 0.5 m; taken 5 s after a.jpg"
    elsewhere = proposed(posed, [known(-1, 900, 0, "a.jpg"), known(1, 902, 0)], [known(0, 901, 0)])
    assert metres_from(elsewhere, 901, 0) < 30
    assert elsewhere.heading is None
