"""The city's files: the same bytes however the work is shared out."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.city import write
from lab.city.plan import CityOptions, make_plan
from lab.city.write import TrainingLayoutName, with_training_layout
from lab.datasets.open_dataset import open_training_set

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


def test_same_photos_can_be_laid_out_as_either_training_set(tmp_path: Path) -> None:
    opened = {}
    for layout in TrainingLayoutName:
        write.write_city(with_training_layout(PLAN, layout), tmp_path / layout)
        opened[layout] = open_training_set(tmp_path / layout)
    xs, original = opened[TrainingLayoutName.GSV_XS], opened[TrainingLayoutName.GSV_CITIES]
    assert (xs.layout, original.layout) == ("gsv_xs", "GSV-Cities")
    assert [p.place_id for p in xs.places] == [p.place_id for p in original.places] == [0, 1]
    for one, other in zip(xs.places, original.places, strict=True):
        assert [p.read_bytes() for p in one.photos] == [p.read_bytes() for p in other.photos]
    assert contents(tmp_path / TrainingLayoutName.GSV_XS / "queries") == contents(
        tmp_path / TrainingLayoutName.GSV_CITIES / "queries"
    )
