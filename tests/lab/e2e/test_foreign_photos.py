"""Photos of elsewhere in maps of generated and of real photos: each is asked for all other sets.

The shipped coefficients were fitted on other cities and other floors. `place_prior`
prints what each of its own pairs would be answered without the map and the set (leave-one-map-out).
"""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from lab.benchmarks.estimates import TrialMap, describe_sets
from lab.city.plan import CityOptions, make_plan
from lab.city.write import write_city
from shared.evaluation.places.probability import PlaceEstimate
from tests.conftest import REAL_PHOTOS

pytestmark = [pytest.mark.numerics, pytest.mark.timeout(900)]  # both, on a busy machine

FLOOR = "floor7"
SHOWN = 24  # photos of each foreign set, at most


def generated_city(folder: Path, seed: int, places: int, views: int) -> Path:
    """Write a city of a style of its own."""
    options = CityOptions(places, views, 8, seed, seed, 0.0, 320, 240, train=False)
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


def shares_answered(folders: Sequence[Path]) -> dict[str, dict[str, float]]:
    """Return the shares of a map's queries, and of the photos of each other set, by map.

    A photo counts if it gets an answer at any level, or is said to be in the map.
    """
    shares: dict[str, dict[str, float]] = {}
    for photos in describe_sets(folders, Progress(disable=True), most_of_each=SHOWN):
        trial = TrialMap(photos, photos.is_database)
        model = trial.fit()
        queries = np.flatnonzero(photos.is_query).tolist()
        shares[photos.name] = {
            name: float(np.mean([_is_answered(j.estimate) for j in trial.judge(model, numbers)]))
            for name, numbers in {"queries": queries, **photos.foreign}.items()
        }
    return shares


def _is_answered(estimate: PlaceEstimate) -> bool:
    return estimate.answer is not None or estimate.in_map is True


@pytest.fixture(autouse=True)
def _default_extractor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXTRACTOR", "efficientnet-lite0-vlad128")


def test_no_pair_of_sets_is_answered(tmp_path: Path) -> None:
    """Two generated cities, and the real photos where PLACEWISE_TEST_DATA names them."""
    folders = [
        generated_city(tmp_path / "rows", 71, places=16, views=2),
        generated_city(tmp_path / "yards", 72, places=32, views=1),
    ]
    maps = ["rows", "yards"]
    if data := os.environ.get(REAL_PHOTOS):
        real = Path(data)
        floor = floor_of(real / "tower", tmp_path / "floor")
        folders = [floor, *folders, real / "toy-places", real / "rides"]
        maps = ["floor", *maps]
    asked = shares_answered(folders)
    assert list(asked) == maps
    for name, shares in asked.items():
        foreign = shares.keys() - {"queries"}
        assert len(foreign) == len(folders) - 1
        assert all(shares[other] <= 0.05 for other in foreign), (name, shares)
    if "floor" in asked:
        assert asked["floor"]["queries"] >= 0.6
