"""The descriptor cache: keyed by content and specification, bounded, safe to kill."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab.evaluation.descriptor_cache import CachedDescriber
from shared.errors import Unprocessable

MUCH = 10**9


class Fake:
    """A row of the file's length for each photo, and the names of the described photos."""

    def __init__(self, dimension: int = 4) -> None:
        self.described: list[str] = []
        self.dimension = dimension
        self.seconds = 0.0
        self.photos = 0

    def __call__(self, photos: Sequence[Path]) -> Iterator[Any]:
        for begin in range(0, len(photos), 3):
            batch = photos[begin : begin + 3]
            self.described += [photo.name for photo in batch]
            self.seconds += 0.010 * len(batch)
            self.photos += len(batch)
            yield np.stack([self.row(photo) for photo in batch])

    def row(self, photo: Path) -> Any:
        return np.full(self.dimension, len(photo.read_bytes()), np.float32)


@pytest.fixture
def photos(tmp_path: Path) -> list[Path]:
    found = [tmp_path / f"{n}.jpg" for n in range(40)]
    for n, photo in enumerate(found):
        photo.write_bytes(bytes(n + 1))
    return found


def all_rows(describe: CachedDescriber, photos: Sequence[Path]) -> Any:
    return np.concatenate(list(describe(photos)))


def test_rows_come_in_the_photos_order_whatever_was_there_already(
    photos: list[Path], tmp_path: Path
) -> None:
    inner = Fake()
    describe = CachedDescriber(inner, tmp_path / "cache", {"a": 1}, max_bytes=MUCH)
    all_rows(describe, photos[5:30:3])
    rows = all_rows(describe, photos)
    assert rows[:, 0].tolist() == [n + 1 for n in range(40)]
    assert sorted(inner.described) == sorted(photo.name for photo in photos), "each was made once"


def test_photo_with_other_bytes_is_described_again(photos: list[Path], tmp_path: Path) -> None:
    inner = Fake()
    describe = CachedDescriber(inner, tmp_path / "cache", {"a": 1}, max_bytes=MUCH)
    all_rows(describe, photos[:2])
    photos[1].write_bytes(bytes(99))
    (tmp_path / "moved.jpg").write_bytes(bytes(1))
    rows = all_rows(describe, [tmp_path / "moved.jpg", photos[1]])
    assert rows[:, 0].tolist() == [1, 99]
    assert inner.described == ["0.jpg", "1.jpg", "1.jpg"], "a photo's name does not matter"


def test_another_specification_has_rows_of_its_own(photos: list[Path], tmp_path: Path) -> None:
    for dimension in (4, 7):
        inner = Fake(dimension)
        spec = {"dimension": dimension}
        describe = CachedDescriber(inner, tmp_path / "cache", spec, max_bytes=MUCH)
        assert all_rows(describe, photos[:3]).shape == (3, dimension)


def test_interrupted_run_goes_on_where_it_was(photos: list[Path], tmp_path: Path) -> None:
    inner = Fake()
    rows = CachedDescriber(inner, tmp_path / "cache", {"a": 1}, max_bytes=MUCH)(photos)
    next(rows)
    next(rows)
    rows.close()  # type: ignore[attr-defined]
    again = Fake()
    describe = CachedDescriber(again, tmp_path / "cache", {"a": 1}, max_bytes=MUCH)
    assert all_rows(describe, photos)[:, 0].tolist() == [n + 1 for n in range(40)]
    assert len(again.described) == 8, "of 40, one batch of 32 was stored"


def test_rows_that_were_refused_are_not_kept(photos: list[Path], tmp_path: Path) -> None:
    """Whoever takes a batch may end the run over it, before it is stored."""
    rows = CachedDescriber(Fake(), tmp_path / "cache", {"a": 1}, max_bytes=MUCH)(photos[:3])
    next(rows)
    with pytest.raises(Unprocessable):
        rows.throw(Unprocessable("features_not_finite", ""))  # type: ignore[attr-defined]
    again = Fake()
    all_rows(CachedDescriber(again, tmp_path / "cache", {"a": 1}, max_bytes=MUCH), photos[:3])
    assert len(again.described) == 3


def test_time_a_photo_is_remembered(photos: list[Path], tmp_path: Path) -> None:
    made = CachedDescriber(Fake(), tmp_path / "cache", {"a": 1}, max_bytes=MUCH)
    assert made.milliseconds_a_photo() is None
    all_rows(made, photos[:6])
    later = CachedDescriber(Fake(), tmp_path / "cache", {"a": 1}, max_bytes=MUCH)
    assert later.milliseconds_a_photo() == pytest.approx(10)


def test_what_was_used_longest_ago_makes_room(photos: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "cache"

    def fill(name: str, max_bytes: int) -> Fake:
        inner = Fake(dimension=20_000)  # 80 kB a row
        all_rows(CachedDescriber(inner, folder, {"a": name}, max_bytes=max_bytes), photos[:10])
        return inner

    fill("old", MUCH)
    fill("new", MUCH)
    fill("third", 2_400_000)  # two and a half of them
    assert fill("new", MUCH).described == []
    assert fill("third", MUCH).described == []
    assert len(fill("old", MUCH).described) == 10


def test_cache_without_room_still_describes(photos: list[Path], tmp_path: Path) -> None:
    for _ in range(2):
        inner = Fake()
        describe = CachedDescriber(inner, tmp_path / "cache", {"a": 1}, max_bytes=0)
        assert all_rows(describe, photos)[:, 0].tolist() == [n + 1 for n in range(40)]
        assert len(inner.described) == 40
