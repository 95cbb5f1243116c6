"""`placewise locate` on generated walks: photos proposed, and how many of them are right.

    placewise datasets synth CITY --places 300 --rides 500 --no-ladder --no-train
    python -m lab.benchmarks.places.locate CITY [--seeds 10] [--share 0.15]

The rides of the city are slowed down to walks; where a ride jumps to another street, half an hour
passes. A photo is taken at a random share of the frames, and a random half of the photos loses its
coordinates. The clock of the camera is CLOCK_ERROR_SECONDS ahead of the GPX track, which has a
point every few frames. Part of each ride is outside the map. A proposal is right if the photo was
taken within 100 m of it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np

from lab.benchmarks.places.estimates import CERTAINTY, TrialMap, describe_set
from lab.datasets.dataset import DatasetPhoto
from lab.datasets.open_dataset import evaluation_set_names, open_evaluation_set
from lab.evaluation.sequences import split_sequences
from services.cli.output import Table, print_table, progress_bar
from shared.evaluation.calibration import expected_calibration_error
from shared.evaluation.places.evidence import PhotoLocation
from shared.evaluation.places.probability import PlaceModel
from shared.geodesy import distance_m
from shared.geotagging.evidence import (
    KnownPosition,
    PictureEvidence,
    ProbableCircle,
    SimilarPosition,
    interpolate_position,
)
from shared.geotagging.fusion import propose_position
from shared.tracks.motion import MOTION_MODELS

START = datetime(2026, 5, 1, tzinfo=UTC)
SECONDS_A_FRAME = 6.0  # of 6 to 10 m
JUMP_M = 50.0
JUMP_SECONDS = 1800.0
POINT_FRAMES = 5
POINT_NOISE_M = 5.0
CLOCK_ERROR_SECONDS = 10.0
RADIUS_M = 100.0
DEGREES_PER_M = 360 / 40_030_000
SOURCES = ("picture", "picture, neighbours", "picture, neighbours, GPX", "neighbours", "GPX")


@dataclass(frozen=True, slots=True)
class Judged:
    """A proposal for a photo."""

    probability: float
    is_right: bool


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("city", type=Path)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--share", type=float, default=0.15, help="frames that are photos")
    arguments = parser.parse_args()
    name = next(n for n in evaluation_set_names(arguments.city) if n.endswith("_rides"))
    rides = open_evaluation_set(arguments.city, name)
    with progress_bar() as progress:
        described = describe_set(arguments.city, progress, name)
    map_ = TrialMap(described, ~described.is_query)
    model = map_.fit()
    for members in split_sequences(rides.queries):
        frames = [rides.queries[member] for member in members]
        pictures = [_picture_of(map_, model, len(map_.members) + member) for member in members]
        judged: dict[str, list[Judged]] = {}
        for seed in range(arguments.seeds):
            for source, proposals in _locate_walk(frames, pictures, seed, arguments.share).items():
                judged.setdefault(source, []).extend(proposals)
        print_table(_figures_table(str(frames[0].sequence), judged))


def _picture_of(map_: TrialMap, model: PlaceModel, query: int) -> PictureEvidence:
    """Return what the search of the map says about a frame, as `placewise locate` reads it."""
    ranking, _ = map_.search(query)
    estimate = map_.estimate(query, model)
    assert estimate is not None
    return PictureEvidence(
        [
            SimilarPosition(*degrees(found.location), found.score, str(found.photo))
            for found in ranking
        ],
        [
            ProbableCircle(
                float(level.latitude or 0), float(level.longitude or 0), level.radius_m or 0, share
            )
            for level, share in zip(estimate.levels, estimate.probabilities, strict=True)
        ],
        estimate.not_in_map,
        len(map_.members),
    )


def _locate_walk(
    frames: Sequence[DatasetPhoto], pictures: Sequence[PictureEvidence], seed: int, share: float
) -> dict[str, list[Judged]]:
    """Draw photos of a walk, and judge what is proposed for those without coordinates."""
    rng = np.random.default_rng(seed)
    times = _walk_times(frames)
    ahead = timedelta(seconds=CLOCK_ERROR_SECONDS)
    known = [
        KnownPosition(time, *degrees(frame)) for time, frame in zip(times, frames, strict=True)
    ]
    track = [
        KnownPosition(
            point.time - ahead,
            point.latitude + float(rng.normal(0, POINT_NOISE_M)) * DEGREES_PER_M,
            point.longitude + float(rng.normal(0, POINT_NOISE_M)) * DEGREES_PER_M,
        )
        for point in known[::POINT_FRAMES]
    ]
    taken = np.flatnonzero(rng.random(len(frames)) < share)
    stripped = rng.random(len(taken)) < 0.5
    located = [known[number] for number in taken[~stripped].tolist()]
    speed = MOTION_MODELS["walk"].max_speed_mps
    judged: dict[str, list[Judged]] = {source: [] for source in SOURCES}
    for number in taken[stripped].tolist():
        neighbours = interpolate_position(located, times[number], speed)
        on_track = interpolate_position(track, times[number], speed)
        for source in SOURCES:
            proposal = propose_position(
                pictures[number] if "picture" in source else None,
                neighbours if "neighbours" in source else None,
                on_track if "GPX" in source else None,
                RADIUS_M,
            )
            if proposal is None:
                judged[source].append(Judged(0.0, is_right=False))
                continue
            away = distance_m(
                proposal.latitude,
                proposal.longitude,
                known[number].latitude,
                known[number].longitude,
            )
            judged[source].append(Judged(proposal.probability, away <= RADIUS_M))
    return judged


def _walk_times(frames: Sequence[DatasetPhoto]) -> list[datetime]:
    """Return the times of the frames, with half an hour before each jump."""
    seconds = [0.0]
    for before, after in pairwise(frames):
        jumped = distance_m(*degrees(before), *degrees(after)) > JUMP_M
        seconds.append(seconds[-1] + (JUMP_SECONDS if jumped else SECONDS_A_FRAME))
    return [START + timedelta(seconds=each) for each in seconds]


def _figures_table(name: str, judged: dict[str, list[Judged]]) -> Table:
    """Return a table of shares in %."""
    table = Table(
        "sources", "photos", "proposed at 0.95", "right", "most at 95 % right", "ECE", title=name
    )
    for source, proposals in judged.items():
        accepted = [each.is_right for each in proposals if each.probability >= CERTAINTY]
        error = expected_calibration_error(
            [each.probability for each in proposals], [each.is_right for each in proposals]
        )
        table.add_row(
            source,
            str(len(proposals)),
            f"{100 * len(accepted) / len(proposals):.1f}",
            f"{100 * np.mean(accepted):.1f}" if accepted else "-",
            f"{100 * _most_proposed(proposals):.1f}",
            f"{error:.3f}",
        )
    return table


def _most_proposed(proposals: Sequence[Judged]) -> float:
    """Return the largest share of photos that any threshold proposes with 95 % of them right."""
    ordered = sorted(proposals, key=lambda each: -each.probability)
    right = np.cumsum([each.is_right for each in ordered])
    precise = right >= CERTAINTY * np.arange(1, len(ordered) + 1)
    return float(np.flatnonzero(precise).max(initial=-1) + 1) / len(ordered)


def degrees(photo: DatasetPhoto | PhotoLocation) -> tuple[float, float]:
    """Return latitude and longitude; photos of generated cities have both."""
    assert photo.latitude is not None
    assert photo.longitude is not None
    return photo.latitude, photo.longitude


if __name__ == "__main__":
    main()
