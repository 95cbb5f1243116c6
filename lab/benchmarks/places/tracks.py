"""The filter of tracks without photos: time of a step on a large map, and a hard railway.

    python -m lab.benchmarks.places.tracks [--photos 100000] [--frames 300]

*City*: photos at random positions of streets 100 m apart; each frame has 200 hits, of which a few
are near the camera. *Railway*: a map of 3,576 photos without coordinates; the scores of a frame are
noise that moves along with the camera for some frames, as similar views do, and a small peak at the
right photo. All parameters are the filter's defaults.
"""

from __future__ import annotations

import argparse
import time
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from shared.evaluation.places.levels import LevelScheme
from shared.tracks.belief import Belief
from shared.tracks.evidence import frame_evidence
from shared.tracks.filter import TrackFilter
from shared.tracks.motion import MOTION_MODELS
from shared.tracks.photo_graph import ArrayPhotoGraph, PhotoTable

START = datetime(2026, 1, 1, tzinfo=UTC)
HITS = 200
RAILWAY_PHOTOS = 3576
TOLERANCE_FRAMES = 10
DEGREES_PER_M = 360 / 40_030_000
STREETS_M = 100.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=300)
    arguments = parser.parse_args()
    print(_measure_city(arguments.photos, arguments.frames))
    for peak in (2.6, 3.2):
        print(_measure_railway(peak, arguments.frames))


def _measure_city(photos: int, frames: int) -> str:
    """Follow a car through a city, and measure CPU time and memory."""
    rng = np.random.default_rng(0)
    side_m = STREETS_M * max(2, round((photos / 10) ** 0.5))  # 20 photos per 100 m of street
    positions = rng.uniform(0, side_m, (photos, 2))
    along = rng.integers(2, size=photos)
    rows = np.arange(photos)
    positions[rows, along] = np.round(positions[rows, along] / STREETS_M) * STREETS_M
    graph = ArrayPhotoGraph(
        PhotoTable.of_rows(
            (str(row), y * DEGREES_PER_M, x * DEGREES_PER_M, None, None, None, None)
            for row, (x, y) in enumerate(positions.tolist())
        )
    )
    track_filter, belief = TrackFilter(graph, MOTION_MODELS["car"]), None
    seconds, largest, right = [], 0, 0
    for number in range(frames):
        camera = np.array([STREETS_M, 5 * STREETS_M + 10.0 * number]) % side_m
        away = np.hypot(*(positions - camera).T)
        scores = rng.normal(size=photos) + 5.0 * np.exp(-((away / 15) ** 2))
        hits = np.argsort(-scores)[:HITS]
        evidence = frame_evidence(
            START + timedelta(seconds=number),
            [str(hit) for hit in hits],
            scores[hits].tolist(),
            photos,
        )
        started = time.process_time()
        belief = track_filter.advance(belief, evidence)
        state = track_filter.state(belief)
        seconds.append(time.process_time() - started)
        largest = max(largest, len(belief.to_bytes()))
        right += state.photo is not None and away[int(state.photo)] <= 25
    milliseconds = 1000 * np.percentile(seconds, [50, 95])
    return (
        f"city of {photos} photos: {milliseconds[0]:.1f} ms of CPU time a frame (p95 "
        f"{milliseconds[1]:.1f}), belief at most {largest / 1000:.0f} kB, "
        f"{right / frames:.1%} of {frames} frames within 25 m"
    )


def _railway_scores(rng: np.random.Generator, peak: float, frames: int) -> NDArray[np.float64]:
    """Draw (frames, RAILWAY_PHOTOS) scores; frame i is at photo i."""
    views = rng.normal(size=(frames, RAILWAY_PHOTOS))
    for _ in range(3):
        views = (views + np.roll(views, (1, 1), axis=(0, 1))) / np.sqrt(2)
    scores: NDArray[np.float64] = np.sqrt(0.5) * (views + rng.normal(size=views.shape))
    for shift in range(-2, 3):
        rows = np.arange(max(0, -shift), frames)
        scores[rows, rows + shift] += peak * np.exp(-abs(shift) / 1.5)
    return scores


def _measure_railway(peak: float, frames: int) -> str:
    """Follow a train along a map without coordinates."""
    motion = MOTION_MODELS["train"]
    radius_m = (TOLERANCE_FRAMES + 0.5) * motion.typical_speed_mps
    graph = ArrayPhotoGraph(
        PhotoTable.of_rows(
            (str(row), None, None, None, None, "map", float(row)) for row in range(RAILWAY_PHOTOS)
        )
    )
    scores = _railway_scores(np.random.default_rng(0), peak, frames)
    scheme = LevelScheme(labels_are_paths=False, radii_m=(radius_m,))
    track_filter = TrackFilter(graph, motion, scheme)
    belief: Belief | None = None
    single, found = [], []
    for number, row in enumerate(scores):
        hits = np.argsort(-row)[:HITS]
        evidence = frame_evidence(
            START + timedelta(seconds=number),
            [str(hit) for hit in hits],
            row[hits].tolist(),
            RAILWAY_PHOTOS,
        )
        belief = track_filter.advance(belief, evidence)
        photo = track_filter.state(belief).photo
        single.append(abs(int(hits[0]) - number) <= TOLERANCE_FRAMES)
        found.append(photo is not None and abs(int(photo) - number) <= TOLERANCE_FRAMES)
    return (
        f"railway, {frames} frames: within {TOLERANCE_FRAMES} frames {np.mean(single):.1%} by "
        f"single frames, {np.mean(found):.1%} by the filter"
    )


if __name__ == "__main__":
    main()
