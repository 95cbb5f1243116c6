"""The city's geometry: a pinhole camera in streets of real metres."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lab.city.camera import Camera, cast_rays
from lab.city.plan import CityOptions, CityPlan, PlannedPhoto, make_plan
from lab.city.raster import SUPERSAMPLING
from lab.city.scene import CityStyle, Scene
from lab.city.sessions import NIGHT, SUMMER
from lab.city.streets import Quarter

OPTIONS = CityOptions(
    places=60, views=4, queries=80, seed=3, catalogue_seed=1, out_of_map=0.25, width=96, height=72
)


@pytest.fixture(scope="module")
def plan() -> CityPlan:
    return make_plan(OPTIONS)


@pytest.fixture(scope="module")
def scene(plan: CityPlan) -> Scene:
    return Scene(plan.quarters["map"], CityStyle(1))


def of_role(plan: CityPlan, role: str) -> list[PlannedPhoto]:
    return [shot for shot in plan.photos if shot.role == role]


def facing(quarter: Quarter, side: int, distance: float) -> Camera:
    """A camera square to the middle of a facade row, that many metres before it."""
    row = quarter.sides[side]
    outwards = np.array([row.direction[1], -row.direction[0]])
    spot = row.start + row.direction * row.length / 2 + outwards * distance
    yaw = math.degrees(math.atan2(*-outwards))
    return Camera(float(spot[0]), float(spot[1]), yaw, fov=70, width=160, height=120)


def test_point_on_the_axis_is_seen_in_the_middle() -> None:
    camera = Camera(10.0, 20.0, yaw=90.0, fov=90.0, eye=1.5, width=200, height=100)
    x, y, depth = camera.project(np.array([[15.0, 20.0, 1.5], [15.0, 15.0, 1.5]]))
    assert x == pytest.approx([100, 200])  # 45 degrees to the right is the edge of 90 degrees
    assert y == pytest.approx([50, 50])
    assert depth == pytest.approx([5, 5])


def test_pitch_turns_the_camera_upwards_and_roll_clockwise() -> None:
    ahead = np.array([[0.0, 5.0, 1.9]])
    level = Camera(0.0, 0.0, yaw=0.0, fov=70.0)
    _, y, _ = replace(level, pitch=5.0).project(ahead)
    assert y == pytest.approx(120 + level.focal * math.tan(math.radians(5)))
    x, y, _ = replace(level, roll=90.0).project(ahead + np.array([1.0, 0.0, 0.0]))
    assert x == pytest.approx(160)
    assert y == pytest.approx(120 - level.focal / 5)


def test_ray_of_a_pixel_meets_the_points_that_project_to_it() -> None:
    camera = Camera(3.0, -4.0, yaw=25.0, fov=80.0, pitch=7.0, roll=-3.0)
    pixels = np.array([0.5, 90.0, 319.5]), np.array([0.5, 200.0, 239.5])
    x, y, depth = camera.project(camera.position + 12.0 * camera.rays(*pixels))
    assert x == pytest.approx(pixels[0])
    assert y == pytest.approx(pixels[1])
    assert depth == pytest.approx(12.0)


def test_wall_is_hit_from_its_front_and_the_nearest_hides_the_others() -> None:
    rays = np.array([[0.0, 1.0], [-0.6, 0.8]])
    starts = np.array([[-30.0, 20.0], [-5.0, 9.0], [9.0, 5.0]])
    directions = np.array([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]])  # the last one is seen from behind
    hits = cast_rays(np.zeros(2), rays, starts, directions, np.array([60.0, 10.0, 18.0]))
    assert hits.wall.tolist() == [1, 0]
    assert hits.distance == pytest.approx([9.0, 25.0])
    assert hits.along == pytest.approx([5.0, 15.0])


def test_what_one_camera_sees_stands_where_another_one_sees_it(
    plan: CityPlan, scene: Scene
) -> None:
    """Points of one view, with their depth, are found at their pixels and depths in another."""
    camera = facing(plan.quarters["map"], 12, 9.0)
    other = replace(
        camera, x=camera.x + 1.1, y=camera.y - 0.7, yaw=camera.yaw + 8, pitch=4.0, roll=3.0
    )
    before, after = (scene.view(each, SUMMER) for each in (camera, other))
    rows, columns = (before.nearness > 0).nonzero()
    rays = camera.rays((columns + 0.5) / SUPERSAMPLING, (rows + 0.5) / SUPERSAMPLING)
    points = camera.position + rays / before.nearness[rows, columns, None]
    x, y, depth = other.project(points)
    column, row = (np.floor(v * SUPERSAMPLING).astype(int) for v in (x, y))
    height, width = after.texels.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    assert inside.mean() > 0.6
    found = after.nearness[row[inside], column[inside]]
    same_depth = np.isclose(1 / found, depth[inside], rtol=0.02)
    assert same_depth.mean() > 0.9  # the rest is hidden by something nearer
    colours = [
        view.texels.view(np.uint8).reshape(*view.texels.shape, 4)[..., :3].astype(int)
        for view in (before, after)
    ]
    ours = colours[0][rows[inside], columns[inside]][same_depth]
    theirs = colours[1][row[inside], column[inside]][same_depth]
    unmoved = colours[1][rows[inside], columns[inside]][same_depth]
    assert (np.abs(ours - theirs).max(axis=1) < 20).mean() > 0.85
    assert (np.abs(ours - theirs).mean()) < 0.5 * np.abs(ours - unmoved).mean()


def test_session_changes_the_light_and_not_the_geometry(plan: CityPlan, scene: Scene) -> None:
    camera = of_role(plan, "database")[7].camera
    # The same day's vehicles and leaves, in the light of the night.
    night = replace(NIGHT, name="summer", foliage="summer")
    day_view, night_view = scene.view(camera, SUMMER), scene.view(camera, night)
    assert np.array_equal(day_view.texels, night_view.texels)
    assert np.array_equal(day_view.nearness, night_view.nearness)


def test_a_camera_that_looks_the_other_way_sees_none_of_the_houses(
    plan: CityPlan, scene: Scene
) -> None:
    seen = {
        shot.place: houses_seen(scene, shot.camera, 25.0)
        for shot in of_role(plan, "database")
        if shot.number % OPTIONS.views == 0
    }
    turned = [shot for shot in of_role(plan, "query") if shot.kind == "other_way"]
    assert turned
    for shot in turned:
        assert not houses_seen(scene, shot.camera, 25.0) & seen[shot.place]


def houses_seen(scene: Scene, camera: Camera, within_m: float) -> set[tuple[int, int]]:
    return {house for house, away in scene.visible_houses(camera).items() if away < within_m}


def test_no_camera_stands_in_a_house(plan: CityPlan) -> None:
    for shot in plan.photos:
        quarter = plan.quarters[shot.quarter]
        away = quarter.side_starts - shot.camera.position[:2]
        across = away[:, 0] * quarter.side_directions[:, 1]
        across = across - away[:, 1] * quarter.side_directions[:, 0]
        blocks = across.reshape(-1, 4)  # a block has four sides; inside all of them is inside
        assert not (blocks > 0).all(axis=1).any()
