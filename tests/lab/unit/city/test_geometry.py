"""The city's geometry: a pinhole camera in streets of real metres."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from lab.city.camera import (
    SUPERSAMPLING,
    Camera,
    RenderBuffers,
    TextureCache,
    cast_rays,
)
from lab.city.catalogue import Catalogue, make_catalogue
from lab.city.plan import CityOptions, CityPlan, PlannedPhoto, make_plan
from lab.city.render import QuarterRenderer
from lab.city.sessions import NIGHT, SESSIONS, SUMMER
from lab.city.streets import Quarter

OPTIONS = CityOptions(
    places=60, views=4, queries=80, seed=3, catalogue_seed=1, out_of_map=0.25, width=96, height=72
)


@pytest.fixture(scope="module")
def plan() -> CityPlan:
    return make_plan(OPTIONS)


@pytest.fixture(scope="module")
def catalogue() -> Catalogue:
    return make_catalogue(1)


@pytest.fixture(scope="module")
def painter(plan: CityPlan, catalogue: Catalogue) -> QuarterRenderer:
    return QuarterRenderer(plan.quarters["map"], catalogue, TextureCache())


def of_role(plan: CityPlan, role: str) -> list[PlannedPhoto]:
    return [shot for shot in plan.photos if shot.role == role]


def facing(quarter: Quarter, side: int, distance: float) -> Camera:
    """A camera square to the middle of a facade row, that many metres before it."""
    row = quarter.sides[side]
    outwards = np.array([row.direction[1], -row.direction[0]])
    spot = row.start + row.direction * row.length / 2 + outwards * distance
    yaw = math.degrees(math.atan2(*-outwards))
    return Camera(float(spot[0]), float(spot[1]), yaw, fov=70, width=160, height=120)


def moved_right(camera: Camera, metres: float) -> Camera:
    spot = camera.position + camera.right * metres
    return replace(camera, x=float(spot[0]), y=float(spot[1]))


def test_point_on_the_axis_is_seen_in_the_middle_of_the_horizon() -> None:
    camera = Camera(10.0, 20.0, yaw=90.0, fov=90.0, eye=1.5, width=200, height=100, horizon=0.5)
    x, y, depth = camera.project(np.array([[15.0, 20.0, 1.5], [15.0, 15.0, 1.5]]))
    assert x == pytest.approx([100, 200])  # 45 degrees to the right is the edge of 90 degrees
    assert y == pytest.approx([50, 50])
    assert depth == pytest.approx([5, 5])


def test_a_step_aside_moves_near_points_more_than_far_ones() -> None:
    camera = Camera(0.0, 0.0, yaw=0.0, fov=72.0)
    points = np.array([[2.0, 8.0, 3.0], [2.0, 40.0, 3.0]])
    before, _, depth = camera.project(points)
    after, _, _ = moved_right(camera, 1.2).project(points)
    assert before - after == pytest.approx(camera.focal * 1.2 / depth)
    assert (before - after)[0] > 4 * (before - after)[1]


def test_ray_meets_a_facade_where_the_point_projects() -> None:
    camera = Camera(3.0, -4.0, yaw=25.0, fov=80.0, width=320)
    start, direction = np.array([[-20.0, 9.0]]), np.array([[0.96, 0.28]])
    hits = cast_rays(camera, camera.slopes(1), start, direction, np.array([60.0]))
    seen = np.isfinite(hits.depth)
    assert seen.sum() > 200
    points = start + hits.along[seen, None] * direction
    x, _, depth = camera.project(np.column_stack([points, np.zeros(len(points))]))
    assert x == pytest.approx(np.flatnonzero(seen) + 0.5)
    assert depth == pytest.approx(hits.depth[seen])


def test_facade_is_not_seen_from_behind() -> None:
    camera = Camera(0.0, 0.0, yaw=0.0, fov=60.0)
    start, direction = np.array([[10.0, 9.0]]), np.array([[-1.0, 0.0]])
    hits = cast_rays(camera, camera.slopes(1), start, direction, np.array([20.0]))
    assert not np.isfinite(hits.depth).any()


def test_nearest_facade_hides_the_others() -> None:
    camera = Camera(0.0, 0.0, yaw=0.0, fov=60.0)
    starts = np.array([[-30.0, 20.0], [-5.0, 9.0]])
    directions = np.array([[1.0, 0.0], [1.0, 0.0]])
    hits = cast_rays(camera, camera.slopes(1), starts, directions, np.array([60.0, 10.0]))
    assert hits.plane[160] == 1
    assert hits.depth[160] == pytest.approx(9.0)
    assert hits.plane[0] == 0  # beside the short one


def test_drawn_facade_moves_by_the_pinhole_formula_and_keeps_its_size(
    plan: CityPlan, painter: QuarterRenderer
) -> None:
    side, distance, pixels = 12, 9.0, 16
    camera = facing(plan.quarters["map"], side, distance)
    step = pixels / SUPERSAMPLING * distance / camera.focal
    before = facade_of(painter.view(camera, SUMMER), distance)
    after = facade_of(painter.view(moved_right(camera, step), SUMMER), distance)
    both = (before[pixels:] > 0) & (after[:-pixels] > 0)
    same = before[pixels:] == after[:-pixels]
    assert both.mean() > 0.2
    assert same[both].mean() > 0.85  # the rest is rounded to the texel beside
    unmoved = (before == after)[pixels:][both]
    assert same[both].mean() > unmoved.mean() + 0.2


def facade_of(
    view: RenderBuffers, distance: float
) -> np.ndarray[tuple[int, int], np.dtype[np.uint32]]:
    """The canvas where the facade at that depth shows; 0 where trees and cars stand before it."""
    at_wall = np.abs(view.depth - distance) < 0.01
    return np.where(np.kron(at_wall, np.ones((SUPERSAMPLING, SUPERSAMPLING), bool)), view.canvas, 0)


def test_session_changes_the_light_and_not_the_geometry(
    plan: CityPlan, painter: QuarterRenderer
) -> None:
    camera = of_role(plan, "database")[7].camera
    # The same day's vehicles and leaves, in the light of the night.
    night = replace(NIGHT, name="summer", foliage="summer")
    day_view, night_view = painter.view(camera, SUMMER), painter.view(camera, night)
    assert np.array_equal(day_view.canvas, night_view.canvas)
    assert np.array_equal(day_view.depth, night_view.depth)


def test_vehicles_are_others_on_another_day_and_houses_are_not(
    plan: CityPlan, painter: QuarterRenderer
) -> None:
    shots = of_role(plan, "database")[::8]
    other_day = replace(SUMMER, name="another summer day")
    changed = [
        painter.view(shot.camera, SUMMER).canvas != painter.view(shot.camera, other_day).canvas
        for shot in shots
    ]
    assert np.mean([mask.any() for mask in changed]) > 0.5
    assert np.mean(changed) < 0.35


def test_neighbouring_places_share_houses(plan: CityPlan) -> None:
    quarter = plan.quarters["map"]
    database = [s for s in of_role(plan, "database") if s.number % OPTIONS.views == 0]
    houses = {shot.place: houses_seen(quarter, shot.camera) for shot in database}
    places = {shot.place: shot.camera.position for shot in database}
    neighbours = [
        (a, b) for a, b in pairwise(sorted(houses)) if np.hypot(*(places[a] - places[b])) < 26
    ]
    assert len(neighbours) > 20
    assert all(houses[a] & houses[b] for a, b in neighbours)
    assert all(houses[a] != houses[b] for a, b in neighbours)


def test_who_looks_the_other_way_sees_none_of_the_houses(plan: CityPlan) -> None:
    quarter = plan.quarters["map"]
    seen = {
        s.place: houses_seen(quarter, s.camera, 25)
        for s in of_role(plan, "database")
        if s.number % OPTIONS.views == 0
    }
    turned = [s for s in of_role(plan, "query") if s.kind == "other_way"]
    assert turned
    for shot in turned:
        assert not houses_seen(quarter, shot.camera, 25) & seen[shot.place]


def houses_seen(quarter: Quarter, camera: Camera, within_m: float = 60.0) -> set[tuple[int, int]]:
    hits = cast_rays(
        camera,
        camera.slopes(1),
        quarter.side_starts,
        quarter.side_directions,
        quarter.side_lengths,
    )
    return {
        (int(side), int(np.searchsorted(quarter.sides[side].cuts, along, side="right")))
        for side, along, depth in zip(hits.plane, hits.along, hits.depth, strict=True)
        if depth < within_m
    }


def test_no_camera_stands_in_a_house(plan: CityPlan) -> None:
    for shot in plan.photos:
        quarter = plan.quarters[shot.quarter]
        away = quarter.side_starts - shot.camera.position
        across = away[:, 0] * quarter.side_directions[:, 1]
        across = across - away[:, 1] * quarter.side_directions[:, 0]
        blocks = across.reshape(-1, 4)  # a block has four sides; inside all of them is inside
        assert not (blocks > 0).all(axis=1).any()


def test_sessions_lie_days_apart_and_have_names_of_their_own() -> None:
    days = sorted(session.starts_at.date() for session in SESSIONS)
    assert all((later - earlier).days >= 2 for earlier, later in pairwise(days))
    assert len({session.name for session in SESSIONS}) == len(SESSIONS)
