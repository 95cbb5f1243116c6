"""Photos of elsewhere in a map of real photos: one floor of a tower, asked for other places."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from lab.benchmarks.estimates import DescribedPhotos, TrialMap, describe_set

pytestmark = [pytest.mark.numerics, pytest.mark.real_photos]

FLOOR = "floor7"
OTHERS = ("toy-places", "rides")


@pytest.fixture(scope="module")
def floor(real_photos: Path, tmp_path_factory: pytest.TempPathFactory) -> DescribedPhotos:
    folder = tmp_path_factory.mktemp("floor")
    for part in ("database", "queries"):
        (folder / part).mkdir()
        with (real_photos / "tower" / f"{part}.csv").open() as table:
            rows = [row for row in csv.reader(table) if f"/{FLOOR}/" in f"/{row[1]}/"]
        lines = [",".join(row) for row in [["filename", "place"], *rows]]
        (folder / f"{part}.csv").write_text("\n".join(lines) + "\n")
        for name, _ in rows:
            (folder / part / name).symlink_to(real_photos / "tower" / part / name)
    return describe_set(folder, Progress(disable=True), [real_photos / name for name in OTHERS])


def test_its_queries_are_answered_and_photos_of_elsewhere_are_not(floor: DescribedPhotos) -> None:
    trial = TrialMap(floor, ~floor.is_query)
    model = trial.fit()
    own = [trial.estimate(query, model) for query in np.flatnonzero(floor.is_query).tolist()]
    assert np.mean([each is not None and each.answer is not None for each in own]) >= 0.6
    for name in OTHERS:
        estimates = [trial.estimate_row(row, model) for row in floor.foreign[name]]
        assert len(estimates) > 20
        answered = [each is not None and each.answer is not None for each in estimates]
        accepted = [each is not None and each.in_map is True for each in estimates]
        assert np.mean(answered) <= 0.05, name
        assert np.mean(accepted) <= 0.05, name
