"""Smoothing a long track in parts, which bounds its memory."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from lab.evaluation.array_photo_graph import ArrayPhotoGraph
from shared.tracks import filter as filter_module
from shared.tracks.evidence import FrameEvidence, frame_evidence
from shared.tracks.filter import TrackFilter
from shared.tracks.photo_graph import PhotoTable

pytestmark = pytest.mark.numerics

PHOTOS, FRAMES, HITS = 20, 60, 8
NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)


def make_ride() -> list[FrameEvidence]:
    """Frames along a street; in each, the right photo scores higher than most others."""
    rng = np.random.default_rng(0)
    frames = []
    for number in range(FRAMES):
        scores = rng.random(PHOTOS)
        scores[number * PHOTOS // FRAMES] += 1.0
        best = np.argsort(-scores)[:HITS]
        time = NOON + timedelta(seconds=number)
        ids = [str(photo) for photo in best]
        frames.append(frame_evidence(time, ids, scores[best].tolist(), PHOTOS))
    return frames


def test_a_track_that_is_smoothed_in_parts_has_the_beliefs_of_the_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = [(str(i), 45 + i * 1e-4, 7.0, None, None, None, None) for i in range(PHOTOS)]
    track_filter = TrackFilter(ArrayPhotoGraph(PhotoTable.of_rows(rows)))
    ride = make_ride()
    whole = track_filter.smooth(ride)
    monkeypatch.setattr(filter_module, "SMOOTHED_AT_ONCE", 10)
    monkeypatch.setattr(filter_module, "LATER_FRAMES", 30)
    parts = track_filter.smooth(ride)
    assert [belief.time for belief in parts] == [frame.time for frame in ride]
    for one, other in zip(parts, whole, strict=True):
        assert one.photos == other.photos
        assert one.probabilities == pytest.approx(other.probabilities, abs=1e-2)
