"""The city's files: the same bytes however the work is shared out."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lab.city import write
from lab.city.plan import CityOptions, make_plan
from lab.evaluation.recall import positives_within, recall_at_k

PLAN = make_plan(CityOptions(2, 4, 4, 1, 2, 0.25, 64, 64))


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_bytes_do_not_depend_on_how_many_processes_draw(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[int] = []
    write.write_city(PLAN, tmp_path / "alone", drawn.append)
    assert drawn == [len(PLAN.photos)]
    monkeypatch.setattr(write, "PHOTOS_PER_TASK", 7)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    drawn.clear()
    write.write_city(PLAN, tmp_path / "shared", drawn.append)
    assert len(drawn) == 3
    assert sum(drawn) == len(PLAN.photos) == 8 + 4 + 8
    assert contents(tmp_path / "alone") == contents(tmp_path / "shared")


def test_average_colours_do_not_tell_places_apart() -> None:
    plan = make_plan(CityOptions(80, 1, 40, 0, 0, 0.0, 64, 64, train=False))
    renderer = write.PhotoRenderer(plan)

    def colours_and_positions(role: str) -> list[np.ndarray[Any, np.dtype[np.float64]]]:
        photos = [photo for photo in plan.photos if photo.role == role]
        pixels = [Image.open(io.BytesIO(renderer.render(photo))) for photo in photos]
        return [
            np.array([np.asarray(each, float).mean(axis=(0, 1)) for each in pixels]),
            np.array([(photo.camera.x, photo.camera.y) for photo in photos]),
        ]

    (queries, query_positions), (database, positions) = map(
        colours_and_positions, ("query", "database")
    )
    away = np.linalg.norm(queries[:, None] - database, axis=2)
    positives = positives_within(query_positions, positions)
    assert recall_at_k(np.argsort(away, axis=1), positives)[1] < 0.15
