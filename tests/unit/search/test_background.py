"""The background of a query: which frames it consists of, and what remains without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.search.worker import QueryRowReader
from shared.search_api.background import (
    MAX_BACKGROUND_ROWS,
    WINDOW_FRAMES,
    background_frames,
    subtract_background,
)
from shared.search_api.protocol import RowReference
from shared.storage import FolderStore
from shared.storage.chunks import encode_rows

pytestmark = pytest.mark.numerics


def unit(rows: np.ndarray) -> np.ndarray:
    rows /= np.linalg.norm(rows, axis=-1, keepdims=True)
    return rows.astype(np.float32)


@pytest.mark.parametrize("number", [0, 1, 31, 32, 33, 100, 511, 512, 513, 1000, 9999])
def test_the_background_is_spread_over_the_last_frames(number: int) -> None:
    frames = background_frames(number)
    assert len(frames) <= MAX_BACKGROUND_ROWS
    assert len(frames) >= min(number, MAX_BACKGROUND_ROWS // 2)
    assert all(max(0, number - WINDOW_FRAMES) <= frame < number for frame in frames)
    assert frames == sorted(set(frames))


def test_successive_frames_share_their_background() -> None:
    for number in (40, 300, 2000):
        before, after = (set(background_frames(n)) for n in (number, number + 1))
        assert len(after - before) <= 1


def test_what_all_frames_of_a_ride_share_does_not_decide_the_ranking() -> None:
    rng = np.random.default_rng(0)
    places = unit(rng.normal(size=(200, 64)))
    snow = unit(rng.normal(size=64))
    places[:20] = unit(places[:20] + 2.0 * snow)  # photos that look like snow anywhere
    ride = unit(places[100:160] + 3.0 * snow)
    raw = ride[40:] @ places.T
    centred = np.stack(
        [subtract_background(ride[n], ride[background_frames(n)]) for n in range(40, 60)]
    )
    right = np.arange(140, 160)
    assert (raw.argmax(axis=1) == right).mean() < 0.2
    assert ((centred @ places.T).argmax(axis=1) == right).mean() > 0.9
    assert np.linalg.norm(centred, axis=1) == pytest.approx(np.ones(20), abs=1e-6)


def test_a_camera_that_stands_still_does_not_subtract_its_own_view() -> None:
    view = unit(np.random.default_rng(1).normal(size=32))
    rest = subtract_background(view, np.tile(view, (MAX_BACKGROUND_ROWS, 1)))
    assert rest == pytest.approx(view, abs=1e-5)
    assert subtract_background(view, ()) is view


def test_rows_that_have_expired_are_left_out_of_the_background(tmp_path: Path) -> None:
    rows = unit(np.random.default_rng(2).normal(size=(3, 8)))
    store = FolderStore(tmp_path)
    store.put("queries/a", encode_rows(rows))
    references = [
        RowReference(object_key="queries/gone", row=0),
        RowReference(object_key="queries/a", row=2),
        RowReference(object_key="queries/a", row=3),
    ]
    reader = QueryRowReader(store)
    (found,) = reader.read_background(references)
    assert found.tolist() == rows[2].tolist()
    store.delete("queries/a")
    (cached,) = reader.read_background(references)
    assert cached.tolist() == rows[2].tolist()
