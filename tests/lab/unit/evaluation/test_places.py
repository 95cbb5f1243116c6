"""Answers at the levels of places, measured on the queries of a data set."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from lab.datasets.dataset import DatasetPhoto, EvaluationSet
from lab.evaluation.exact_knn import Rows, exact_knn
from lab.evaluation.places import measure_places
from shared.evaluation.places.levels import LevelScheme

pytestmark = pytest.mark.numerics

FLOORS, ROOMS, VIEWS = 4, 6, 5
NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)
PATHS = LevelScheme(labels_are_paths=True, radii_m=(25.0,))
CIRCLES = LevelScheme(labels_are_paths=False, radii_m=(25.0, 100.0, 500.0))


def make_photo(name: str, floor: int, room: int, *, view: int = 0) -> DatasetPhoto:
    """A photo of a room. Rooms of a floor are 100 m apart, floors 3 km."""
    return DatasetPhoto(
        Path(name),
        name,
        easting=500_000.0 + 100 * room,
        northing=5_000_000.0 + 3000 * floor,
        zone="32T",
        place=f"tower/floor {floor}/room {room}",
        captured_at=NOON + timedelta(days=view),
    )


def unit_rows(rooms: Rows, noise: float, seed: int) -> Rows:
    drawn = np.random.default_rng(seed).standard_normal(rooms.shape).astype(np.float32)
    rows: Rows = rooms + noise * drawn / np.sqrt(rooms.shape[1])
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return rows


@pytest.fixture(scope="module")
def building() -> tuple[EvaluationSet, Rows, Rows]:
    """A building with five views of each room, and queries, the last ones of a missing floor."""
    places = [(floor, room) for floor in range(FLOORS + 1) for room in range(ROOMS)]
    rng = np.random.default_rng(0)
    looks = {place: rng.standard_normal(64) for place in places}
    mapped = places[: FLOORS * ROOMS]
    shots = [(*place, view) for place in mapped for view in range(VIEWS)]
    database = tuple(make_photo(f"d{shot}.jpg", *shot[:2], view=shot[2]) for shot in shots)
    queries = tuple(make_photo(f"q{place}.jpg", *place) for place in places)
    of_place = [
        np.array([i for i, shot in enumerate(shots) if shot[:2] == place], np.int64)
        for place in places
    ]
    rows = [
        unit_rows(np.array([looks[each] for each in group], np.float32), 0.8, seed)
        for seed, group in enumerate(([shot[:2] for shot in shots], places))
    ]
    made = EvaluationSet(
        "building", Path(), database, queries, tuple(of_place), "place-label", "placewise"
    )
    return made, rows[0], rows[1]


@pytest.mark.parametrize(("scheme", "levels"), [(PATHS, 3), (CIRCLES, 4)])
def test_clear_queries_are_answered_and_those_outside_the_map_are_not(
    building: tuple[EvaluationSet, Rows, Rows], scheme: LevelScheme, levels: int
) -> None:
    evaluation_set, database, queries = building
    ranked = exact_knn(queries, database, 50)
    places = measure_places(evaluation_set, database, ranked, scheme, 25.0)
    assert places is not None
    assert (places["source"], places["own_photos"]) == ("own_photos", len(database))
    assert places["samples"] == len(queries)
    assert len(places["levels"]) == levels
    at_80, *_, at_99 = places["answers"]
    assert at_80["answered_at_finest_level"]["mean"] >= 0.7
    assert at_80["precision"]["mean"] >= 0.8
    assert at_80["outside_at_finest_level"] <= 0.2
    assert at_99["answered"]["mean"] <= at_80["answered"]["mean"]


def test_the_model_is_fitted_on_a_sample_of_a_large_database(
    building: tuple[EvaluationSet, Rows, Rows],
) -> None:
    evaluation_set, database, queries = building
    ranked = exact_knn(queries, database, 50)
    places = measure_places(evaluation_set, database, ranked, PATHS, 25.0, sampled_photos=30)
    assert places is not None
    assert places["own_photos"] == 30


def test_a_set_without_known_locations_has_no_levels(
    building: tuple[EvaluationSet, Rows, Rows],
) -> None:
    made, database, queries = building
    unknown = [
        tuple(DatasetPhoto(photo.path, photo.name) for photo in photos)
        for photos in (made.database, made.queries)
    ]
    evaluation_set = replace(made, database=unknown[0], queries=unknown[1])
    ranked = exact_knn(queries, database, 50)
    assert measure_places(evaluation_set, database, ranked, PATHS, 25.0) is None
