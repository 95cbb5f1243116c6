"""Figures of tracks on data sets with sequences, and their layouts."""

from __future__ import annotations

from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lab.city.plan import CityOptions, make_plan
from lab.datasets.open_dataset import open_evaluation_set
from lab.evaluation.sequences import (
    FrameResult,
    evaluate_sequence,
    prepare_map,
    sequence_figures,
    split_sequences,
)
from shared.tracks.belief import TrackStatus
from shared.tracks.motion import MOTION_MODELS
from tests.lab.unit.data_sets import msls_city, write_csv, write_photos

pytestmark = pytest.mark.numerics


def season_folders(root: Path, count: int) -> Path:
    for season in ("summer", "winter"):
        (root / season).mkdir(parents=True)
        for number in range(count):
            Image.new("L", (64, 32)).save(root / season / f"{number:05d}.png")
    return root


def test_two_folders_of_seasons_are_followed_by_their_numbers(tmp_path: Path) -> None:
    found = open_evaluation_set(season_folders(tmp_path / "rail", 60))
    assert (found.name, found.rule, len(found.database)) == ("rail_winter", "frames 10", 60)
    rng = np.random.default_rng(0)
    views = rng.normal(size=(60, 32))
    summer, winter = (views + rng.normal(size=views.shape) for _ in range(2))
    rows = [
        (each / np.linalg.norm(each, axis=1)[:, None]).astype("f4") for each in (summer, winter)
    ]
    motion = MOTION_MODELS["train"]
    map_ = prepare_map(found, rows[0], motion)
    (members,) = split_sequences(found.queries)
    frames, seconds = evaluate_sequence(map_, found, members, rows[1], motion)
    figures = sequence_figures([frames])
    assert seconds > 0
    assert figures["recall"]["filter"] > figures["recall"]["single"]
    assert figures["recall"]["filter"] > 0.9
    assert figures["frames_outside"] == 0


def follow(root: Path, views: np.ndarray, motion: str) -> dict[str, Any]:
    """Evaluate the sequences of a set whose photos look like the views of their places."""
    found = open_evaluation_set(root)
    rng = np.random.default_rng(1)
    database, queries = (
        np.stack([views[int(photo.path.stem)] for photo in photos])
        for photos in (found.database, found.queries)
    )
    database, queries = (rows + 1.3 * rng.normal(size=rows.shape) for rows in (database, queries))
    database, queries = (
        (rows / np.linalg.norm(rows, axis=1)[:, None]).astype("f4") for rows in (database, queries)
    )
    speeds = MOTION_MODELS[motion]
    map_ = prepare_map(found, database, speeds)
    sequences = split_sequences(found.queries)
    return sequence_figures(
        [evaluate_sequence(map_, found, m, queries[m], speeds)[0] for m in sequences]
    )


def test_a_map_with_labels_only_is_followed_by_the_photos_of_its_labels(tmp_path: Path) -> None:
    views = np.random.default_rng(0).normal(size=(80, 24))
    for table in ("database", "queries"):
        write_photos(tmp_path, [f"{table}/{number}.jpg" for number in range(80)])
        write_csv(
            tmp_path / f"{table}.csv",
            ("path", "place", "frame", "sequence"),
            [(f"{number}.jpg", f"room {number // 4}", number, table) for number in range(80)],
        )
    figures = follow(tmp_path, views, "walk")
    assert figures["recall"]["single"] < 0.8
    assert figures["recall"]["filter"] > figures["recall"]["single"] + 0.1


def test_sequences_of_the_msls_layout_are_followed_by_their_frame_numbers(tmp_path: Path) -> None:
    views = np.random.default_rng(0).normal(size=(200, 24))
    for city, side in product(("cph", "sf"), ("database", "query")):
        numbers = range(100) if city == "cph" else range(100, 200)
        msls_city(
            tmp_path / "train_val" / city / side,
            [
                {"key": f"{n:03d}", "m": 10 * n, "sequence": city + side, "frame": n}
                for n in numbers
            ],
        )
    figures = follow(tmp_path, views, "bicycle")
    assert figures["recall"]["single"] < 0.8
    assert figures["recall"]["filter"] > figures["recall"]["single"] + 0.1


def result(
    *, inside: bool, right: bool, status: TrackStatus = "tracking", start: bool = False
) -> FrameResult:
    probability = 0.9 if right else 0.1
    return FrameResult(0, inside, start, right, right, right, 0.5, probability, status)


def test_figures_count_the_frames_until_a_place_is_found_and_until_a_track_is_lost() -> None:
    sequence = [
        result(inside=True, right=False, status="converging", start=True),
        result(inside=True, right=False),
        result(inside=True, right=True),
        result(inside=False, right=False),
        result(inside=False, right=False, status="lost"),
        result(inside=True, right=True, start=True),
    ]
    figures = sequence_figures([sequence])
    assert figures["frames_to_localise"] == [2, 0]
    assert figures["frames_to_notice_lost"] == [1]
    assert figures["recall"]["filter"] == 0.5
    assert figures["recall_at_99_precision"]["filter"] == 0.5
    assert figures["tracking_precision"] == 0.5


def test_a_ride_is_the_same_in_each_season_with_stops_a_detour_and_a_jump() -> None:
    options = CityOptions(200, 1, 4, 0, 0, 0.0, 64, 64, False, 200)
    photos = [photo for photo in make_plan(options).photos if photo.role == "ride"]
    by_season = {
        name: sorted((p for p in photos if p.session.name == name), key=lambda p: p.number)
        for name in ("winter", "night")
    }
    winter, night = by_season["winter"], by_season["night"]
    assert [len(winter), len(night)] == [200, 200]
    assert [p.place for p in winter] == [p.place for p in night]
    outside = [p.number for p in winter if p.kind == "out_of_map"]
    assert outside == list(range(outside[0], outside[0] + 30))
    steps = [
        np.hypot(a.camera.x - b.camera.x, a.camera.y - b.camera.y)
        for a, b in pairwise(winter)
        if a.kind == b.kind == "in_map"
    ]
    assert min(steps) < 1.0
    assert sorted(steps)[-2] < 30.0
