"""Evaluation of tracks on data sets with sequences: single frames and the filter.

A frame is right if the photo that it is matched to is a positive of the set's rule. Frames without
positives were taken outside the map; there every answer is wrong. Both use the same
descriptors; the filter searches with the earlier frames as the background, as the API does.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.datasets.dataset import DatasetPhoto, EvaluationSet
from lab.datasets.ground_truth import parse_rule
from lab.evaluation.array_photo_graph import ArrayPhotoGraph
from lab.evaluation.places import RANKS, SAMPLED_PHOTOS, measure_background
from lab.evaluation.retrieval_metrics import precision_recall
from shared.evaluation.calibration import expected_calibration_error
from shared.evaluation.places.evidence import EVIDENCE_DEPTH, PhotoLocation, RankedPhoto
from shared.evaluation.places.fit import MapScores, fit_place_model
from shared.evaluation.places.levels import LevelScheme
from shared.evaluation.places.samples import IndexRanking, OwnPhotoSampler
from shared.place_paths import look_like_paths
from shared.search_api.background import PRIOR_ROWS, background_frames
from shared.tracks.belief import Belief, TrackStatus
from shared.tracks.evidence import HITS, FrameEvidence, frame_evidence
from shared.tracks.filter import TrackFilter
from shared.tracks.motion import MotionModel
from shared.tracks.photo_graph import PhotoTable

Rows = NDArray[np.float32]

COARSE_RADII_M = (100.0, 500.0, 2000.0)
JUMP_M = 100.0
"""between two frames, from which on the camera was carried away"""
NOTICE_FRAMES = 20
"""frames after which a track outside the map must be lost"""


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What single frames and the filter answer for a frame."""

    query: int
    """index in the evaluation set"""
    has_positive: bool
    is_start: bool
    """whether the track begins here: first frame, back in the map, or carried away"""
    single_is_right: bool
    filter_is_right: bool
    smoothed_is_right: bool
    single_score: float
    probability: float
    status: TrackStatus


@dataclass(frozen=True)
class SequenceMap:
    """The map of a set: its photos, as the filter needs them, with descriptors."""

    photos: Sequence[DatasetPhoto]
    rows: Rows
    """(n, D), of unit length"""
    graph: ArrayPhotoGraph
    scheme: LevelScheme
    judge: Callable[[NDArray[np.float32]], float | None]
    """returns the log-odds that the map lacks a frame's place, from its (n,) scores"""


def prepare_map(evaluation_set: EvaluationSet, rows: Rows, motion: MotionModel) -> SequenceMap:
    """Build the photo graph, and fit the place model of a map with labels.

    Args:
        evaluation_set: The set; its rule is the tolerance.
        rows: (n, D) descriptors of its database photos, of unit length.
        motion: For the distance between photos without coordinates.
    """
    photos = evaluation_set.database
    rule = parse_rule(evaluation_set.rule.removesuffix(" m"))
    finest = (rule.frames + 0.5) * motion.typical_speed_mps
    if rule.kind != "frames":
        finest = rule.radius_m
    coarser = tuple(radius for radius in COARSE_RADII_M if radius > finest)
    labels = {photo.place for photo in photos if photo.latitude is None} - {None}
    is_path = look_like_paths([label for label in labels if label is not None])
    scheme = LevelScheme(labels_are_paths=is_path, radii_m=(finest, *coarser))
    table = PhotoTable.of_rows(
        (
            str(number),
            photo.latitude,
            photo.longitude,
            photo.heading,
            photo.place,
            None if photo.frame is None else photo.sequence or "",
            None if photo.frame is None else float(photo.frame),
        )
        for number, photo in enumerate(photos)
    )
    judge = _fit_judge(photos, rows, scheme, rule.radius_m) if labels else lambda _: None
    return SequenceMap(photos, rows, ArrayPhotoGraph(table), scheme, judge)


def _fit_judge(
    photos: Sequence[DatasetPhoto], rows: Rows, scheme: LevelScheme, radius_m: float
) -> Callable[[NDArray[np.float32]], float | None]:
    locations = [PhotoLocation(photo.latitude, photo.longitude, photo.place) for photo in photos]

    def rank(photo: int) -> IndexRanking:
        scores = rows @ rows[photo]
        order = np.argsort(-scores, kind="stable")[: RANKS + 1]
        order = order[order != photo]
        return order, scores[order].astype(np.float64)

    times = [photo.captured_at for photo in photos]
    own_photos = OwnPhotoSampler(locations, times, scheme, radius_m, rank)
    known = np.flatnonzero([location.is_known for location in locations])
    size = min(SAMPLED_PHOTOS, len(known))
    sample = np.sort(np.random.default_rng(0).choice(known, size, replace=False)).tolist()
    spread = own_photos.spread(sample)
    scores = MapScores(spread, measure_background(rows))
    samples = list(own_photos.samples(sample, spread))
    model = fit_place_model(samples, (), scheme, scores).model

    def judge(scores: NDArray[np.float32]) -> float | None:
        order = np.argsort(-scores, kind="stable")
        first = order[np.isin(order, known)][:EVIDENCE_DEPTH].tolist()
        ranking = [RankedPhoto(float(scores[n]), locations[n], n) for n in first]
        return model.missing_log_odds(ranking, own_photos.neighbours(first[0]), scheme, radius_m)

    return judge


def split_sequences(queries: Sequence[DatasetPhoto]) -> list[list[int]]:
    """Return the query indices of each sequence, in the order of frames."""
    sequences: dict[str | None, list[int]] = {}
    for index, photo in enumerate(queries):
        if photo.frame is not None:
            sequences.setdefault(photo.sequence, []).append(index)
    for members in sequences.values():
        members.sort(key=lambda index: queries[index].frame or 0)
    return list(sequences.values())


def evaluate_sequence(
    map_: SequenceMap,
    evaluation_set: EvaluationSet,
    members: Sequence[int],
    rows: Rows,
    motion: MotionModel,
) -> tuple[list[FrameResult], float]:
    """Follow one sequence.

    Args:
        members: Query indices in the order of frames; one may come again, as of another frame.
        rows: (len(members), D) descriptors of these queries, of unit length.

    Returns:
        The frames, and the CPU seconds of the filter per frame.
    """
    scores = rows @ map_.rows.T
    evidence = _frames_of(map_, _times([evaluation_set.queries[n] for n in members]), scores)
    track_filter = TrackFilter(map_.graph, motion, map_.scheme)
    belief: Belief | None = None
    states = []
    started = time.process_time()
    for frame in evidence:
        belief = track_filter.advance(belief, frame)
        states.append(track_filter.state(belief))
    seconds = (time.process_time() - started) / max(len(evidence), 1)
    smoothed = track_filter.smoothed_states(evidence)
    results = []
    for number, index in enumerate(members):
        positives = set(evaluation_set.positives[index].tolist())
        results.append(
            FrameResult(
                query=index,
                has_positive=bool(positives),
                is_start=bool(positives) and _is_start(evaluation_set, members, number),
                single_is_right=int(scores[number].argmax()) in positives,
                filter_is_right=_photo(states[number].photo) in positives,
                smoothed_is_right=_photo(smoothed[number].photo) in positives,
                single_score=float(scores[number].max()),
                probability=states[number].probability,
                status=states[number].status,
            )
        )
    return results, seconds


def _frames_of(map_: SequenceMap, times: Sequence[datetime], scores: Rows) -> list[FrameEvidence]:
    """Return the evidence of the frames of a sequence.

    Scores are linear, so that the background is subtracted from them instead of from the
    descriptors, which are much longer. That leaves out a factor for each frame, on which its
    evidence does not depend.

    Args:
        times: (n,) when the frames were taken.
        scores: (n, photos) of the frames.
    """
    count = min(HITS, scores.shape[1])
    frames = []
    for number, (time_, own) in enumerate(zip(times, scores, strict=True)):
        background = background_frames(number)
        centred = own - scores[background].sum(axis=0) / (len(background) + PRIOR_ROWS)
        order = np.argsort(-centred, kind="stable")[:count]
        found = centred[order].astype(np.float64).tolist()
        ids = [str(photo) for photo in order]
        frames.append(frame_evidence(time_, ids, found, len(own), missing=map_.judge(own)))
    return frames


def _times(queries: Sequence[DatasetPhoto]) -> list[datetime]:
    """Return capture times; without them, frame numbers count seconds.

    Frames that are no later than the one before are resampled: all are the usual interval apart.
    """
    start = datetime(2000, 1, 1, tzinfo=UTC)
    times = [photo.captured_at for photo in queries if photo.captured_at is not None]
    if len(times) < len(queries):
        times = [start + timedelta(seconds=photo.frame or 0) for photo in queries]
    intervals = [after - before for before, after in pairwise(times)]
    positive = sorted(each for each in intervals if each > timedelta())
    if len(positive) == len(intervals):
        return times
    usual = positive[len(positive) // 2] if positive else timedelta(seconds=1)
    return [start + n * usual for n in range(len(queries))]


def _is_start(evaluation_set: EvaluationSet, members: Sequence[int], number: int) -> bool:
    if number == 0 or not len(evaluation_set.positives[members[number - 1]]):
        return True
    pair = members[number - 1 : number + 1]
    metres = np.array(
        [(photo.easting, photo.northing) for photo in (evaluation_set.queries[n] for n in pair)],
        dtype=np.float64,
    )
    return bool(np.hypot(*(metres[1] - metres[0])) > JUMP_M)  # not for unknown ones, NaN


def _photo(photo: str | None) -> int:
    return -1 if photo is None else int(photo)


def sequence_figures(sequences: Sequence[Sequence[FrameResult]]) -> dict[str, Any]:
    """Compute the figures of the frames of all sequences.

    Recall is over frames with positives; `calibration_error` over all frames.
    """
    frames = [frame for sequence in sequences for frame in sequence]
    inside = [frame for frame in frames if frame.has_positive]
    tracked = [frame for frame in frames if frame.status == "tracking"]
    localised, noticed, claimed = [], [], []
    for sequence in sequences:
        for start, frame in enumerate(sequence):
            if frame.is_start:
                localised.append(_frames_until_right(sequence, start))
            elif start and not frame.has_positive and sequence[start - 1].has_positive:
                later = sequence[start : start + NOTICE_FRAMES + 1]
                noticed.append(next((n for n, f in enumerate(later) if f.status == "lost"), None))
        outside = _frames_outside(sequence)
        claimed += [sequence[n].status == "tracking" for n, o in outside if o >= NOTICE_FRAMES]
    return {
        "frames": len(frames),
        "frames_outside": len(frames) - len(inside),
        "recall": {
            name: _share([getattr(frame, f"{name}_is_right") for frame in inside])
            for name in ("single", "filter", "smoothed")
        },
        "recall_at_99_precision": {
            name: curve.recall_at(0.99) if curve else None
            for name, score in (("single", "single_score"), ("filter", "probability"))
            for curve in [
                precision_recall(
                    np.array([getattr(frame, score) for frame in frames]),
                    np.array([getattr(frame, f"{name}_is_right") for frame in frames]),
                    len(inside),
                )
            ]
        },
        "tracking": _share([frame.status == "tracking" for frame in inside]),
        "tracking_precision": _share([frame.filter_is_right for frame in tracked]),
        "calibration_error": expected_calibration_error(
            [frame.probability for frame in frames], [frame.filter_is_right for frame in frames]
        ),
        "frames_to_localise": localised,
        "frames_to_notice_lost": noticed,
        "claimed_outside": _share(claimed),
    }


def _frames_until_right(sequence: Sequence[FrameResult], start: int) -> int | None:
    """Return the frames until the place is tracked and right; None if the camera leaves before."""
    for number, frame in enumerate(sequence[start:]):
        if number and (frame.is_start or not frame.has_positive):
            return None
        if frame.status == "tracking" and frame.filter_is_right:
            return number
    return None


def _frames_outside(sequence: Sequence[FrameResult]) -> list[tuple[int, int]]:
    """Return the number of each frame outside the map, with how long it has been outside."""
    found, since = [], 0
    for number, frame in enumerate(sequence):
        since = 0 if frame.has_positive else since + 1
        if since:
            found.append((number, since - 1))
    return found


def _share(values: Sequence[bool]) -> float | None:
    return float(np.mean(values)) if len(values) else None
