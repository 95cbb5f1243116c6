"""Small maps and frames for the tests of tracks."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

from lab.evaluation.array_photo_graph import ArrayPhotoGraph
from shared.geodesy import EARTH_RADIUS_M
from shared.tracks.evidence import FrameEvidence, Hit
from shared.tracks.photo_graph import PhotoTable

START = datetime(2026, 1, 1, tzinfo=UTC)


def line_map(count: int) -> ArrayPhotoGraph:
    """A street: photos every 10 metres to the east, on the equator, looking east."""
    degrees = np.degrees(10.0 / EARTH_RADIUS_M)
    return ArrayPhotoGraph(
        PhotoTable.of_rows(
            (str(number), 0.0, number * degrees, 90.0, None, None, None) for number in range(count)
        )
    )


def sequence_map(count: int) -> ArrayPhotoGraph:
    """A film: photos of one sequence, one per second, without coordinates."""
    return ArrayPhotoGraph(
        PhotoTable.of_rows(
            (str(number), None, None, None, None, "film", float(number)) for number in range(count)
        )
    )


def at(seconds: float) -> datetime:
    """The time so many seconds after the start."""
    return START + timedelta(seconds=seconds)


def frame(seconds: float, probabilities: Sequence[float]) -> FrameEvidence:
    """A frame with a hit at each photo 0, 1, ...; other photos have the rest."""
    hits = tuple(
        Hit(photo=str(number), score=probability, probability=probability)
        for number, probability in enumerate(probabilities)
    )
    return FrameEvidence(time=at(seconds), hits=hits)


def pointing_at(photo: int, count: int, seconds: float, probability: float = 0.7) -> FrameEvidence:
    """A frame that shows one of `count` photos."""
    probabilities = np.full(count, (1.0 - probability) / (count - 1))
    probabilities[photo] = probability
    return frame(seconds, probabilities.tolist())
