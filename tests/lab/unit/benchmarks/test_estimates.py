"""The benchmark of place estimates, on a map whose photos are points around their places."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from lab.benchmarks import estimates
from lab.benchmarks.estimates import DescribedPhotos
from shared.errors import Misconfigured
from shared.evaluation.places.evidence import PhotoLocation
from shared.evaluation.places.levels import LevelScheme
from tests.support.commands import run

PLACES, PER_PLACE, FLOORS = 24, 6, 8


def described(per_place: int = PER_PLACE) -> DescribedPhotos:
    rng = np.random.default_rng(0)
    rows = np.repeat(rng.normal(size=(PLACES, 16)), per_place, 0)
    rows += 0.3 * rng.normal(size=rows.shape)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    places = [f"house/{n % FLOORS}/{n}" for n in range(PLACES) for _ in range(per_place)]
    return DescribedPhotos(
        "house",
        rows.astype(np.float32),
        [PhotoLocation(None, None, place) for place in places],
        [None] * len(places),
        np.arange(len(places)) % per_place == 0,
        np.arange(len(places)) // per_place,
        LevelScheme(labels_are_paths=True, radii_m=(25.0,)),
        25.0,
    )


def with_foreign(photos: DescribedPhotos) -> DescribedPhotos:
    """The set with photos of elsewhere, which are unlike all of the map."""
    return replace(
        photos,
        rows=np.concatenate([photos.rows, -photos.rows[:20]]),
        locations=[*photos.locations, *[PhotoLocation(None, None, None)] * 20],
        captured_at=[*photos.captured_at, *[None] * 20],
        is_query=np.append(photos.is_query, np.zeros(20, dtype=bool)),
        clusters=np.append(photos.clusters, 1000 + np.arange(20)),
        foreign={"elsewhere": range(len(photos.rows), len(photos.rows) + 20)},
    )


def test_without_a_folder_the_tower_of_the_test_data_is_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    described_folders: list[Path] = []

    def describe(folders: Sequence[Path], _: Progress) -> Iterator[DescribedPhotos]:
        described_folders.extend(folders)
        photos = with_foreign(described())
        assert photos.is_database.sum() == (~described().is_query).sum()
        yield photos

    monkeypatch.setattr(estimates, "describe_sets", describe)
    monkeypatch.setenv("PLACEWISE_TEST_DATA", str(tmp_path))
    output = run("bench", "estimates", "--splits", 1, code=None).output
    assert described_folders == [tmp_path / "tower"]
    assert "house, half of its queries labelled" in output
    assert "95 % interval" in output
    assert "house, photos of elsewhere" in output
    monkeypatch.delenv("PLACEWISE_TEST_DATA")
    with pytest.raises(Misconfigured, match="PLACEWISE_TEST_DATA"):
        estimates.bench()
