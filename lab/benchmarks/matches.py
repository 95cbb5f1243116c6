"""Matches of local features: their cost, and what they add to place estimates.

    placewise bench matches [FOLDER...]

Each folder is an evaluation set with coordinates or place labels; without one, it is the folder
`tower` of PLACEWISE_TEST_DATA. Its descriptors and place models are those of `bench estimates`. The
queries are estimated without matches, and with those of their first photos. CPU times are those of
one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lab.benchmarks.estimates import (
    DescribedPhotos,
    Folders,
    add_left_out,
    add_published,
    describe_sets,
    evaluation_folders,
)
from lab.benchmarks.report import Report, printed_report
from services.cli.output import JsonOption
from shared.evaluation.places.evidence import match_support
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import get_preprocessing
from shared.matching.features import LocalFeatures
from shared.matching.mutual_nearest import match_keypoints
from shared.matching.verification import verify_matches
from shared.matching.xfeat import XFeatDetector, load_detector

MAX_FEATURES_MS = 70.0
MAX_PAIR_MS = 12.0
MAX_FEATURE_BYTES = 80_000
SQUARE = get_preprocessing("square32")


class MatchedPhotos:
    """Local features of the photos of a set, and the match support of pairs, each computed once."""

    def __init__(self, features: Callable[[int], LocalFeatures]) -> None:
        self.features = features
        self.match_seconds = self.verify_seconds = 0.0
        """CPU time of all pairs"""
        self.supports: dict[tuple[int, int], float] = {}

    def match(self, photo: int, others: Sequence[Any]) -> list[float | None]:
        """Return the match support of a photo with each of others."""
        return [self._support(*sorted((photo, other))) for other in others]

    def _support(self, first: int, second: int) -> float:
        pair = first, second
        if pair not in self.supports:
            a, b = self.features(first), self.features(second)
            started = time.process_time()
            matches = match_keypoints(a, b)
            matched = time.process_time()
            points = a.working_pixels()[matches[:, 0]], b.working_pixels()[matches[:, 1]]
            inliers = int(verify_matches(*points).sum())
            self.match_seconds += matched - started
            self.verify_seconds += time.process_time() - matched
            self.supports[pair] = match_support(len(matches), inliers)
        return self.supports[pair]


def bench(
    folders: Folders = None,
    as_json: JsonOption = False,
) -> None:
    """Measure the cost of local features, and what their matches add to place estimates."""
    measured = evaluation_folders(folders)
    detector = load_detector(torch.device("cpu"))
    with printed_report(f"matches of {detector.model}", as_json) as (report, progress):
        for photos in describe_sets(measured, progress):
            bar = progress.add_task(f"{photos.name}: local features", total=len(photos.paths))
            features, seconds = detect_all(detector, photos.paths, partial(progress.advance, bar))
            matched = MatchedPhotos(features.__getitem__)
            compare(report, photos, matched)
            add_cost(report, photos.name, features, matched, seconds)


def detect_all(
    detector: XFeatDetector, paths: Sequence[Path], on_photo: Callable[[], object]
) -> tuple[list[LocalFeatures], float]:
    """Return the local features of photos, and the CPU seconds of their detection."""
    torch.set_num_threads(1)
    features, seconds = list[LocalFeatures](), 0.0
    for path in paths:
        photo = decode_photo(path.read_bytes(), SQUARE, 10**9, for_detection=True)
        assert photo.detection_pixels is not None
        started = time.process_time()
        features += detector.detect([photo.detection_pixels], [photo.size])
        seconds += time.process_time() - started
        on_photo()
    return features, seconds


def compare(report: Report, photos: DescribedPhotos, matched: MatchedPhotos) -> None:
    """Report the estimates of the set's queries, and of photos of elsewhere, without and with
    matches."""
    for name, tried in (("without", photos), ("with", replace(photos, match=matched.match))):
        what = f"{photos.name}, {name} matches"
        judged = add_published(report, what, tried)
        recall = 100 * float(np.mean([j.is_right[0] is True for j in judged]))
        report.add(f"{what}: right at the finest level", recall, "%")
        add_left_out(report, what, tried)


def add_cost(
    report: Report,
    name: str,
    features: Sequence[LocalFeatures],
    matched: MatchedPhotos,
    seconds: float,
) -> None:
    """Report CPU times and bytes of the photos and pairs of a set."""
    photos, pairs = len(features), max(1, len(matched.supports))
    size = np.mean([len(each.encode()) for each in features])
    pair_ms = 1000 * (matched.match_seconds + matched.verify_seconds) / pairs
    match_ms = 1000 * matched.match_seconds / pairs
    report.add(f"{name}: CPU a photo", 1000 * seconds / photos, "ms", at_most=MAX_FEATURES_MS)
    report.add(f"{name}: bytes a photo", float(size), "B", at_most=MAX_FEATURE_BYTES)
    report.add(f"{name}: CPU a pair", pair_ms, "ms", at_most=MAX_PAIR_MS)
    report.add(f"{name}: CPU a pair, matching alone", match_ms, "ms")
