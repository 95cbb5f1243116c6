"""Photos of elsewhere in maps of generated and of real photos: each is asked for all other sets.

The generated cities of this test are none of those that the shipped coefficients were fitted on.
The real sets are, so that they are judged by coefficients that were fitted without the map and
without the set that is asked, too.
"""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from lab.benchmarks.estimates import TrialMap, describe_sets
from lab.benchmarks.place_prior import (
    IN_MAP,
    OWN,
    PASSING,
    QUERIES,
    elsewhere_levels,
    fit_log_odds,
)
from lab.city.plan import CityOptions, make_plan
from lab.city.write import write_city
from shared.evaluation.places.levels import FloatArray
from shared.evaluation.places.probability import shipped_prior
from tests.conftest import REAL_PHOTOS

pytestmark = pytest.mark.numerics

FLOOR = "floor7"
SHOWN = 40  # photos of each foreign set, at most


@dataclass(frozen=True, slots=True)
class AskedMap:
    """What a map answers: shares of photos, and their features, by set."""

    answered: Mapping[str, float]
    accepted: Mapping[str, float]
    features: Mapping[str, FloatArray]


def generated_city(folder: Path, seed: int, places: int, views: int) -> Path:
    """Write a city of a style of its own."""
    options = CityOptions(places, views, 20, seed, seed, 0.0, 320, 240, train=False)
    write_city(make_plan(options), folder)
    return folder


def floor_of(tower: Path, folder: Path) -> Path:
    """Link the photos of one floor."""
    for part in ("database", "queries"):
        (folder / part).mkdir(parents=True)
        with (tower / f"{part}.csv").open() as table:
            rows = [row for row in csv.reader(table) if f"/{FLOOR}/" in f"/{row[1]}/"]
        lines = [",".join(row) for row in [["filename", "place"], *rows]]
        (folder / f"{part}.csv").write_text("\n".join(lines) + "\n")
        for name, _ in rows:
            (folder / part / name).symlink_to(tower / part / name)
    return folder


def asked_maps(folders: Sequence[Path]) -> dict[str, AskedMap]:
    asked = {}
    for photos in describe_sets(folders, Progress(disable=True), most_of_each=SHOWN):
        trial = TrialMap(photos, photos.is_database)
        model = trial.fit()
        queries = np.flatnonzero(photos.is_query).tolist()
        sets = {QUERIES: queries, **photos.foreign}
        judged = {name: trial.judge(model, numbers) for name, numbers in sets.items()}
        unit = shipped_prior().elsewhere[photos.extractor]
        asked[photos.name] = AskedMap(
            {n: np.mean([j.estimate.answer is not None for j in js]) for n, js in judged.items()},
            {n: np.mean([j.estimate.in_map is True for j in js]) for n, js in judged.items()},
            {
                name: np.array([unit.features(each) for each in levels])
                for name, levels in elsewhere_levels(photos).items()
            },
        )
    return asked


def check_shipped(asked: Mapping[str, AskedMap]) -> None:
    for name, each in asked.items():
        for other in each.answered.keys() - IN_MAP:
            assert each.answered[other] <= 0.05, (name, other)
            assert each.accepted[other] <= 0.05, (name, other)


@pytest.fixture(autouse=True)
def _default_extractor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXTRACTOR", "efficientnet-lite0-vlad128")


@pytest.fixture(scope="module")
def cities(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("cities")
    return [
        generated_city(folder / "rows", 71, places=26, views=2),
        generated_city(folder / "yards", 72, places=52, views=1),
    ]


def test_generated_cities_of_two_styles_are_not_answered_by_each_other(cities: list[Path]) -> None:
    asked = asked_maps(cities)
    assert [sorted(each.answered) for each in asked.values()] == [
        ["queries", "yards"], ["queries", "rows"],
    ]  # fmt: skip
    check_shipped(asked)


@pytest.mark.real_photos
def test_no_pair_of_real_and_generated_sets_is_answered(cities: list[Path], tmp_path: Path) -> None:
    real = Path(os.environ[REAL_PHOTOS])
    floor = floor_of(real / "tower", tmp_path / "floor")
    asked = asked_maps([floor, *cities, real / "toy-places", real / "rides"])
    assert list(asked) == ["floor", "rows", "yards"]
    assert {len(each.answered) for each in asked.values()} == {5}, "four sets, and its queries"
    check_shipped(asked)
    assert asked["floor"].answered[QUERIES] >= 0.6
    for (name, each), other in itertools.product(asked.items(), asked["floor"].features.keys()):
        if other in IN_MAP or other not in each.features:
            continue
        fitted_on = [
            {k: v for k, v in rest.features.items() if k not in (name, other)}
            for of, rest in asked.items()
            if of not in (name, other)
        ]
        intercept, *slopes = fit_log_odds(fitted_on)
        passing = intercept + each.features[other] @ np.array(slopes) <= PASSING
        assert passing.mean() <= 0.05, (name, other)
        own = intercept + each.features[OWN] @ np.array(slopes) <= PASSING
        assert name != "floor" or own.mean() >= 0.5
