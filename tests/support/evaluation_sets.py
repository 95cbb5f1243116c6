"""What tests ask of an opened evaluation set, and a street to open."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.datasets.open_dataset import EvaluationSet
from shared.errors import PlacewiseError
from tests.support.data_sets import utm_name, write_photos


def pair(base: Path, database: list[float], queries: list[float]) -> None:
    """Photos along one street, at these metres."""
    for name, spots in (("database", database), ("queries", queries)):
        write_photos(base / name, [utm_name(480_000 + m, 4_880_000) for m in spots])


def rows(opened: EvaluationSet) -> list[list[int]]:
    return [found.tolist() for found in opened.positives]


def names(opened: EvaluationSet) -> tuple[list[str], list[str]]:
    return [s.name for s in opened.database], [s.name for s in opened.queries]


def code_of(caught: pytest.ExceptionInfo[PlacewiseError]) -> str:
    return caught.value.code
