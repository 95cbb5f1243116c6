"""`placewise bench rivals` with the engine that every checkout has: faiss."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest
from rich.progress import Progress

from lab.benchmarks.search.rivals import (
    FaissFlat,
    FaissFlatPca,
    Placewise,
    PlacewiseFloat32,
    measure,
    recall,
)
from shared.errors import Misconfigured


def test_exact_engines_find_all_of_the_best_photos_and_a_projection_fewer(tmp_path: Path) -> None:
    rivals = (Placewise, PlacewiseFloat32, FaissFlat, FaissFlatPca)
    report = measure(
        Progress(disable=True),
        photos=300,
        dimension=512,
        pca=8,
        queries=5,
        folder=tmp_path,
        rivals=rivals,
    )
    exact, float32, flat, projected = report.details["engines"]
    assert exact["recall"] == float32["recall"] == flat["recall"] == 1.0
    assert 0.0 < projected["recall"] < 1.0
    assert [each["dimension"] for each in (exact, flat, projected)] == [512, 512, 8]
    assert exact["disk_mb"] < float32["disk_mb"]
    assert [figure.what for figure in report.figures] == [
        f"{rival.name}: query, p50" for rival in rivals
    ]
    assert list(tmp_path.iterdir()) == []


def test_recall_is_the_share_of_the_expected_photos() -> None:
    assert recall([[*range(10)], [*range(5, 15)]], [{*range(10)}, {*range(10)}]) == 0.75


def test_missing_packages_are_named_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def find_spec(name: str) -> Any:
        return None if name in ("lancedb", "qdrant_client") else object()

    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    with pytest.raises(Misconfigured, match=r"lancedb, qdrant_client.*--group rivals"):
        measure(
            Progress(disable=True),
            photos=300,
            dimension=512,
            pca=8,
            queries=5,
            folder=tmp_path,
        )
    assert list(tmp_path.iterdir()) == []
