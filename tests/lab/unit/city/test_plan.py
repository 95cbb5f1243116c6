"""Which photos of the city are taken, and what the 25 m rule says of them."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np
import pytest

from lab.city.plan import CityOptions, CityPlan, PlannedPhoto, make_plan
from lab.datasets.utm_names import parse_utm_file_name
from lab.evaluation.recall import positives_within
from shared.utm_filenames import upload_fields_of_file_name

OPTIONS = CityOptions(
    places=150, views=4, queries=120, seed=5, catalogue_seed=0, out_of_map=0.2, width=64, height=64
)


@pytest.fixture(scope="module")
def plan() -> CityPlan:
    return make_plan(OPTIONS)


def of_role(plan: CityPlan, role: str) -> list[PlannedPhoto]:
    return [shot for shot in plan.photos if shot.role == role]


def positions(shots: list[PlannedPhoto]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.array([(shot.camera.x, shot.camera.y) for shot in shots])


def test_each_place_has_its_views_and_queries_are_as_many_of_each_kind_as_requested(
    plan: CityPlan,
) -> None:
    views = Counter(shot.place for shot in of_role(plan, "database"))
    assert set(views) == set(range(150))
    assert set(views.values()) == {4}
    kinds = Counter(shot.kind for shot in of_role(plan, "query"))
    assert kinds == {"in_map": 88, "other_way": 8, "out_of_map": 24}


def test_queries_on_the_map_have_positives_and_those_outside_are_200_metres_away(
    plan: CityPlan,
) -> None:
    database, queries = of_role(plan, "database"), of_role(plan, "query")
    found = positives_within(positions(queries), positions(database))
    far = positives_within(positions(queries), positions(database), within_m=200.0)
    for shot, near, within_200_m in zip(queries, found, far, strict=True):
        if shot.kind == "out_of_map":
            assert not len(within_200_m)
        else:
            assert len(near)


def test_nothing_to_learn_from_lies_within_200_metres_of_a_query_or_the_database(
    plan: CityPlan,
) -> None:
    searched = positions(of_role(plan, "database") + of_role(plan, "query"))
    found = positives_within(positions(of_role(plan, "train")), searched, within_m=200.0)
    assert not any(len(row) for row in found)


def test_places_of_a_street_lie_15_to_25_metres_apart(plan: CityPlan) -> None:
    middles = defaultdict(list)
    for shot in of_role(plan, "database"):
        middles[shot.place].append(shot.camera.position)
    spots = np.array([np.mean(middles[place], axis=0) for place in sorted(middles)])
    gaps = np.hypot(*(spots[1:] - spots[:-1]).T)
    within_a_street = gaps[gaps < 27]
    assert len(within_a_street) > 80
    assert within_a_street.min() > 13


def test_name_says_where_and_when_the_camera_stood(plan: CityPlan) -> None:
    names = [shot.name for shot in plan.photos]
    assert len(set(names)) == len(names)
    for shot in plan.photos[::17]:
        location = parse_utm_file_name(shot.name)
        assert location is not None
        assert (location.east, location.north) == (shot.camera.x, shot.camera.y)
        fields = upload_fields_of_file_name(shot.name, None)
        assert float(fields["heading"]) == pytest.approx(shot.camera.yaw, abs=0.006)
        assert fields["captured_at"].startswith(shot.session.starts_at.date().isoformat())
