"""Discrete Bayes filter over the photos of a map, and its forward-backward smoother.

The hidden state of a frame is the photo of the map that was taken nearest to it, or "outside the
map" (topological localisation: Cummins and Newman 2008, FAB-MAP; Xu et al. 2021, "Probabilistic
visual place recognition for hierarchical localization"). The belief is sparse: photos that were
found or can be reached have a probability of their own, all others share `elsewhere` equally.

Prediction. With K(i, j) the probability to move from photo i to j (rows add up to 1), r the
probability that the camera was carried away, e and c those of leaving and entering the map:

    p'(j)     = (1 - r - e) * sum_i p(i) K(i, j) + (r * (1 - outside) + c * outside) / n
    outside'  = (1 - c) * outside + e * (1 - outside)

Update. The frame's evidence has posterior probabilities q of a single frame that is in the map, and
its prior is uniform, so n * q(j) is the likelihood up to a factor (Bayes' rule):

    p(j)      ~ p'(j) * (n * q(j)) ** w
    outside   ~ outside' * exp(w * OUTSIDE_GAIN * max(0, min(g, MAX_GAIN) - CHANCE_GAIN))

Photos that are no hits share what the hits leave. Outside the map, frames fit the predicted places
by chance only, yet better than any place: similar streets look similar in successive frames. So
"outside" is measured by the track itself: g is the mean of what the tracked frames gained by the
prediction, log(sum_j p'(j) (n q(j)) ** w / sum_j p'(j)) / w. Where the evidence is weak, g is near
what frames gain by chance, and little speaks for "outside".

Labels leave the frames of a missing floor free to agree on another one. There the place model of
the map counts instead, which says how much a frame alone looks like one that the map lacks, with
log-odds m (`PlaceModel.missing_log_odds`):

    outside   ~ outside' * sum_j p'(j) (n q(j)) ** w / sum_j p'(j) * exp(w * m)

Two frames of the same view are not independent, so w = min(1, NOVELTY_WEIGHT * novelty), where the
novelty is the share of the evidence that is new: the squared Hellinger distance
1 - sum_j sqrt(d(j) d_before(j)) of what exceeds the prior, d(j) ~ max(q(j) - 1 / n, 0), from the
frame before. A camera that stands still adds nothing. SeqSLAM (Milford and Wyeth 2012) sums scores
along lines of constant speed instead; it is the baseline of the evaluation.

The cost of a step does not depend on how many photos are near. Where these are too many, the hits
and the nearest ones have a row of their own, and the others count in the sums that K and the
likelihood of a position fix are divided by (`nearest`). They are no hits, so the frame's evidence
is the same for all of them, and they share `elsewhere` with the rest of the map.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.evaluation.places.levels import LevelScheme
from shared.evaluation.places.probability import OUT_OF_MAP_SHARE
from shared.geodesy import EARTH_RADIUS_M, distance_m
from shared.place_paths import label_levels
from shared.tracks.belief import Belief
from shared.tracks.evidence import FrameEvidence, Odometry, PositionFix
from shared.tracks.motion import DEFAULT_MOTION, MotionModel
from shared.tracks.nearest import MAX_NEAR, find_nearest, weigh_rings
from shared.tracks.photo_graph import (
    MAX_SAME_LABEL,
    FloatArray,
    Indices,
    PhotoGraph,
    PhotoTable,
    distance_matrix_m,
    signed_gap_seconds,
    unit_vectors,
)
from shared.tracks.state import TrackState, follows_sequence, next_status, track_state

KIDNAPPING_RATE = 0.002
"""Probability per frame that the camera goes on at any place of the map"""
LEAVING = 0.002
"""Probability per frame that the camera leaves the map"""
ENTERING = 0.005
"""Probability per frame that a camera outside enters the map, at any place"""
OUTSIDE_GAIN = 0.7
"""Share of the track's gain above CHANCE_GAIN that a frame outside the map must fall below"""
CHANCE_GAIN = 0.45
"""A track that gains no more than this by its frames is not distinguishable from one outside"""
MAX_MISSING = 4.0
"""Log-odds that a single frame speaks for or against "outside", at most"""
START_OUTSIDE = 0.3
"""Probability that a camera whose place is a label is outside the map at first"""
MAX_GAIN = 2.0
"""Where most frames gain more, one in a tunnel gains far less, and is still in the map"""
MAX_GAIN_WEIGHT = 200.0
"""Number of frames that the gain is the mean of, at most: it follows the light and the weather"""
NOVELTY_WEIGHT = 1.5
"""A frame with two thirds of new evidence counts in full"""
WINDOW_SECONDS = 5.0
"""of a map's sequence before and after a photo. How they share the evidence of a window counts in
full even where the camera sees nothing new, so that a camera that stands is not moved on"""
PACE_SPREAD = 0.7
"""Standard deviation of a camera's pace around the learned one, in paces of the map"""
PACE_FRAMES = 30.0
"""Number of tracked frames that the pace is the mean of"""
VELOCITY_FRAMES = 6.0
"""Number of tracked frames that the velocity along coordinates is the mean of: streets turn"""
SIBLINGS_M = 20.0
"""Between two places that have the parent in common in the map's label paths"""
DIRECTION_FRAMES = 50.0
"""Number of frames with new evidence that say whether the camera moves along the map"""
SPACING_M = 10.0
"""Standard deviation between a frame and the photo of the map that shows it"""
MAX_REACH_M = 1000.0
"""A camera that may have moved farther may be anywhere in the map, as if carried away"""
MAX_PHOTOS = 300
"""of a belief; the least probable ones beyond go back to `elsewhere`"""
MOVING_PHOTOS = 100
"""of a belief, the most probable. What is near the others is not added, which bounds the time of a
step while the place is not known"""
ALWAYS_KEPT = 50
MIN_GAIN = 2.0
"""A photo of a belief is at least this much more probable than one elsewhere"""
NEGLIGIBLE = 1e-3
"""Probability that the least probable photos of a belief give back to `elsewhere`"""
FIX_OUTLIERS = 0.02
"""Share of the position fixes that are wrong by more than their accuracy explains"""
HEADING_FLOOR = 0.05
"""Weight of photos that look in a direction which the odometry excludes"""
KERNEL_ROWS = 50
"""Rows of K that are computed together, which bounds the memory of a step"""
SMOOTHED_AT_ONCE = 200
LATER_FRAMES = 100
"""Frames after those that are smoothed at once"""


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """One step of the filter, in the form that the backward pass needs."""

    sources: Indices
    """(n,) rows of the belief before that are still in the map"""
    kernel: FloatArray
    """(n, m) from them to the photos of the belief after it; what is missing to 1 is elsewhere"""
    stay: float
    """1 - r - e"""
    carried_away: float
    leaving: float
    entering: float
    weights: FloatArray
    """(m,) likelihoods of the photos"""
    weight_elsewhere: float
    weight_outside: float
    belief: Belief


class _Place(NamedTuple):
    """The most probable place along the map's sequences."""

    sequence: str
    seconds: float
    probability: float


class TrackFilter:
    """Follows a camera through a map.

    Args:
        motion: How fast the camera moves.
        scheme: The levels of the map, for the state.
    """

    def __init__(
        self,
        graph: PhotoGraph,
        motion: MotionModel = DEFAULT_MOTION,
        scheme: LevelScheme | None = None,
    ) -> None:
        self._graph = graph
        self._motion = motion
        self._scheme = scheme or LevelScheme(
            labels_are_paths=False, radii_m=(25.0, 100.0, 500.0, 2000.0)
        )

    def advance(self, belief: Belief | None, evidence: FrameEvidence) -> Belief:
        """Return the belief after a frame.

        Args:
            belief: The belief after the frame before; None for the first frame.
            evidence: The frame, not older than the belief.

        Raises:
            ValueError: The frame is older than the belief.
        """
        return self._step(belief or _start(evidence), evidence).belief

    def state(self, belief: Belief) -> TrackState:
        """Return where the camera is according to a belief."""
        return track_state(
            belief, self._graph.photos(belief.photos), self._scheme, self._motion.typical_speed_mps
        )

    def smooth(self, frames: Sequence[FrameEvidence]) -> list[Belief]:
        """Return the belief at each frame given all frames, earlier and later.

        This is the forward-backward algorithm (Rabiner 1989) on the sparse beliefs of the forward
        pass; a photo that the forward pass gave up stays given up. In a long track, at least
        LATER_FRAMES later frames count, so that memory does not grow with its length.

        Args:
            frames: In the order of time.
        """
        count = max(self._graph.photo_count, 1)
        steps: list[_Step] = []
        smoothed: list[Belief] = []
        for frame in frames:
            before = steps[-1].belief if steps else _start(frame)
            steps.append(self._step(before, frame))
            if len(steps) == SMOOTHED_AT_ONCE + LATER_FRAMES:
                smoothed += _backward(steps, count)[:SMOOTHED_AT_ONCE]
                del steps[:SMOOTHED_AT_ONCE]
        return smoothed + _backward(steps, count)

    def smoothed_states(self, frames: Sequence[FrameEvidence]) -> list[TrackState]:
        """Return where the camera is at each frame given all frames, in the order of time.

        The status follows from the smoothed probabilities, as that of `advance` does from those
        that were known at the frame.
        """
        beliefs = self.smooth(frames)
        for number in range(len(beliefs) - 2, -1, -1):
            later = beliefs[number + 1].direction * (1 - 1 / DIRECTION_FRAMES)
            if later > beliefs[number].direction:
                beliefs[number] = replace(beliefs[number], direction=later)
        states: list[TrackState] = []
        for belief in beliefs:
            state = self.state(belief)
            before = states[-1].status if states else "converging"
            status = next_status(before, state.probability, state.outside)
            states.append(replace(state, status=status))
        return states

    def _step(self, before: Belief, evidence: FrameEvidence) -> _Step:
        seconds = (evidence.time - before.time).total_seconds()
        if seconds < 0:
            raise ValueError(f"The frame of {evidence.time} is older than {before.time}.")
        count = max(self._graph.photo_count, 1)
        sources = self._graph.photos(before.photos)
        row_of = {photo: row for row, photo in enumerate(before.photos)}
        rows = np.array([row_of[photo] for photo in sources.ids], dtype=np.int64)
        reach_m = self._reach_m(seconds, evidence.odometry)
        moving = np.argsort(-before.probabilities[rows], kind="stable")[:MOVING_PHOTOS]
        reach = min(reach_m, MAX_REACH_M)
        targets, complete_m = self._targets(sources, sources.take(moving), evidence, reach)
        if evidence.fix is not None:
            near_fix, fix_complete_m = _near_fix(self._graph, evidence.fix)
            targets = targets.union(near_fix)
        seen = _excess(evidence, count)
        weight = min(1.0, NOVELTY_WEIGHT * _novelty(before.seen, seen))
        # A camera that sees nothing new has not moved on.
        drift = weight * seconds * np.array(before.velocity)
        reached = partial(self._kernel, sources, targets, complete_m, seconds, evidence, drift)
        kernel = reached(before.pace)
        backwards = reached(-before.pace) if follows_sequence(targets).any() else None

        # Photos that were deleted since have given their probability to the others.
        own = before.probabilities[rows]
        elsewhere = before.elsewhere + float(before.probabilities.sum() - own.sum())
        density = elsewhere / max(count - len(own), 1)
        carried = max(KIDNAPPING_RATE * weight, 1 - MAX_REACH_M / max(reach_m, MAX_REACH_M))
        leaving, entering = LEAVING * weight, ENTERING * weight
        stay = max(0.0, 1 - carried - leaving)
        inside = 1 - before.outside
        entered = (carried * inside + entering * before.outside) / count
        is_new = np.arange(len(targets)) >= len(sources)  # the sources are the first targets
        predicted = stay * (own @ kernel + density * is_new) + entered
        remaining = max(count - len(targets), 0)
        unseen = count - len(own) - int(is_new.sum())
        moved_elsewhere = max(0.0, float(own @ (1 - kernel.sum(axis=1))))
        predicted_elsewhere = (
            stay * (density * max(unseen, 0) + moved_elsewhere) + entered * remaining
        )
        predicted_outside = (1 - entering) * before.outside + leaving * inside

        likelihoods, likelihood_elsewhere = _likelihoods(targets, evidence, count)
        in_map = float(predicted.sum()) + predicted_elsewhere
        windows = _window_likelihoods(targets, predicted, likelihoods)
        weights = likelihoods * windows ** (weight - 1)
        weight_elsewhere = likelihood_elsewhere**weight
        fit = float(predicted @ weights) + predicted_elsewhere * weight_elsewhere
        direction = before.direction
        if backwards is not None:
            reverse = stay * (own @ backwards + density * is_new) + entered
            gained = math.log(float(predicted @ weights) / float(reverse @ weights))
            direction = max(0.0, direction * (1 - weight / DIRECTION_FRAMES) + gained)
        outside_gain = OUTSIDE_GAIN * max(0.0, min(before.gain, MAX_GAIN) - CHANCE_GAIN)
        weight_outside = np.exp(weight * outside_gain) if evidence.hits else 1.0
        if evidence.missing is not None:
            log_odds = float(np.clip(evidence.missing, -MAX_MISSING, MAX_MISSING))
            weight_outside = fit / max(in_map, sys.float_info.min) * math.exp(weight * log_odds)
        if evidence.fix is not None:
            near, elsewhere_near = _fix_weights(targets, evidence.fix, fix_complete_m, count)
            weights, weight_elsewhere = weights * near, weight_elsewhere * elsewhere_near
        posterior = predicted * weights
        posterior_elsewhere = predicted_elsewhere * weight_elsewhere
        posterior_outside = predicted_outside * weight_outside
        total = float(posterior.sum()) + posterior_elsewhere + posterior_outside
        posterior, posterior_elsewhere = posterior / total, posterior_elsewhere / total
        kept = _kept(posterior, posterior_elsewhere / max(remaining, 1))
        after = Belief(
            time=evidence.time,
            photos=tuple(targets.ids[kept].tolist()),
            probabilities=posterior[kept],
            elsewhere=posterior_elsewhere + float(posterior.sum() - posterior[kept].sum()),
            outside=posterior_outside / total,
            seen=seen,
            gain=before.gain,
            gain_weight=before.gain_weight,
            pace=before.pace,
            position=before.position,
            velocity=before.velocity,
            direction=direction,
            status=before.status,
            frames=before.frames + 1,
        )
        state = track_state(after, targets.take(kept), self._scheme, self._motion.typical_speed_mps)
        after = replace(after, status=next_status(before.status, state.probability, after.outside))
        after = self._learn_pace(
            after, _place(sources, own), _place(targets.take(kept), posterior[kept]), seconds
        )
        after = self._learn_velocity(after, state, seconds)
        if evidence.hits and in_map > 0:
            after = _learn_gain(after, float(np.log(fit / in_map)), weight, state.probability)
        return _Step(
            rows,
            kernel[:, kept],
            stay,
            carried,
            leaving,
            entering,
            weights[kept],
            weight_elsewhere,
            weight_outside,
            after,
        )

    def _learn_pace(
        self, belief: Belief, before: _Place | None, after: _Place | None, seconds: float
    ) -> Belief:
        """Move the pace of a belief towards that between two places of a sequence."""
        if before is None or after is None or before.sequence != after.sequence or seconds <= 0:
            return belief
        certainty = min(before.probability, after.probability)
        if certainty < 0.5:
            return belief
        limit = self._motion.max_speed_mps / self._motion.typical_speed_mps
        seen = (after.seconds - before.seconds) / seconds
        if abs(seen) > limit + WINDOW_SECONDS / seconds:
            return replace(belief, direction=0.0)  # carried away
        pace = belief.pace + certainty * (seen - belief.pace) / PACE_FRAMES
        return replace(belief, pace=float(np.clip(pace, -limit, limit)))

    def _learn_velocity(self, belief: Belief, state: TrackState, seconds: float) -> Belief:
        """Move the velocity of a belief towards that from its position to that of the state."""
        known = state.latitude is not None and state.longitude is not None
        if not known or state.probability < 0.5:
            return replace(belief, position=None)
        here = np.array([state.latitude, state.longitude], dtype=np.float64)
        if belief.position is None or seconds <= 0:
            return replace(belief, position=tuple(here.tolist()))
        before, velocity = np.array(belief.position), np.array(belief.velocity)
        seen = np.remainder(here - before + 180, 360) - 180
        if distance_m(*before, *here) > self._motion.max_speed_mps * seconds + SPACING_M:
            velocity[:] = 0.0  # carried away
        else:
            velocity += state.probability * (seen / seconds - velocity) / VELOCITY_FRAMES
        return replace(belief, position=tuple(here.tolist()), velocity=tuple(velocity.tolist()))

    def _distances_m(self, sources: PhotoTable, targets: PhotoTable) -> FloatArray:
        """Return (n, m) distances; the places of a parent are near each other."""
        away = distance_matrix_m(sources, targets, self._motion.typical_speed_mps)
        if self._scheme.labels_are_paths:
            away[np.isinf(away) & _are_siblings(sources, targets)] = SIBLINGS_M
        return away

    def _reach_m(self, seconds: float, odometry: Odometry | None) -> float:
        if odometry is not None:
            return odometry.distance_m + 3 * (odometry.distance_accuracy_m + SPACING_M)
        return self._motion.max_speed_mps * seconds + 3 * SPACING_M

    def _targets(
        self, sources: PhotoTable, moving: PhotoTable, evidence: FrameEvidence, reach_m: float
    ) -> tuple[PhotoTable, float]:
        """Return the photos that have a probability after the step, and the reach of all of them.

        Photos farther from `moving` than that, up to `reach_m`, are among them if they are hits.
        """
        hits = self._graph.photos([hit.photo for hit in evidence.hits])
        if not len(moving):
            return sources.union(hits), reach_m
        speed = self._motion.typical_speed_mps
        near, complete_m = find_nearest(
            lambda reach, limit: self._graph.around(moving, reach, reach / speed, limit),
            reach_m,
            MAX_NEAR,
        )
        return sources.union(hits, near), complete_m

    def _kernel(
        self,
        sources: PhotoTable,
        targets: PhotoTable,
        complete_m: float,
        seconds: float,
        evidence: FrameEvidence,
        drift: FloatArray,
        pace: float,
    ) -> FloatArray:
        """Return (n, m) probabilities to move from source to target photos.

        Rows add up to 1, and to less where photos that can be reached are no targets.
        """
        numbers = _photos_of_targets(self._graph, targets, evidence)
        kernel = np.zeros((len(sources), len(targets)))
        for first in range(0, len(sources), KERNEL_ROWS):
            rows = np.arange(first, min(first + KERNEL_ROWS, len(sources)))
            kernel[rows], moving = self._kernel_rows(
                sources.take(rows),
                targets,
                numbers,
                complete_m,
                seconds,
                evidence.odometry,
                drift,
                pace,
            )
            kernel[rows, rows] += 1 - moving  # the sources are the first targets
        return kernel

    def _kernel_rows(
        self,
        sources: PhotoTable,
        targets: PhotoTable,
        numbers: FloatArray,
        complete_m: float,
        seconds: float,
        odometry: Odometry | None,
        drift: FloatArray,
        pace: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Return (n, m) probabilities to move, and (n,) how probable it is to move at all.

        The photos are coarser than the motion between two frames, so a camera changes its photo
        only so often that it moves no farther than it can on average.
        """
        away = self._distances_m(sources, targets)
        reach_m = min(self._reach_m(seconds, odometry), MAX_REACH_M)
        if odometry is None:
            moved_m = self._motion.max_speed_mps * seconds
            width = float(np.hypot(SPACING_M, moved_m / 2))
            weigh = partial(_gaussian, width=width)
            moved = replace(
                sources,
                latitudes=sources.latitudes + drift[0],
                longitudes=sources.longitudes + drift[1],
            )
            kernel = weigh(self._distances_m(moved, targets) if drift.any() else away)
            gaps = _gaps_along(sources, targets, away, self._motion.typical_speed_mps)
            typical_m = self._motion.typical_speed_mps * seconds
            along = _gaussian(
                gaps - pace * typical_m, math.hypot(SPACING_M, PACE_SPREAD * typical_m)
            )
            kernel = np.where(np.isnan(gaps), kernel, along)
        else:
            moved_m = odometry.distance_m + odometry.distance_accuracy_m
            weigh = partial(_odometry_weights, odometry=odometry)
            kernel = weigh(away) * _heading_weights(sources, targets, odometry)
        kernel[away > reach_m] = 0.0
        kernel *= numbers
        total = kernel.sum(axis=1)
        total_m = np.sum(kernel * np.where(kernel > 0, away, 0.0), axis=1)
        if complete_m < reach_m:
            within = (away <= complete_m) @ numbers
            beyond = np.where(away > complete_m, kernel, 0.0).sum(axis=1)
            located = ~np.isnan(sources.latitudes)
            for dimensions, rows in ((1, ~located), (2, located)):
                ring, ring_m = weigh_rings(weigh, complete_m, reach_m, dimensions)
                unseen = np.maximum(0.0, within[rows] * ring - beyond[rows])
                total[rows] += unseen
                total_m[rows] += unseen * ring_m / max(ring, sys.float_info.min)
        # A photo that nothing can be reached from keeps its probability.
        kernel = np.divide(kernel, total[:, None], out=kernel, where=total[:, None] > 0)
        moving = np.minimum(
            1.0,
            np.divide(moved_m * total, total_m, out=np.ones_like(total), where=total_m > 0),
        )
        moving[total <= 0] = 0.0
        return kernel * moving[:, None], moving


def _start(first: FrameEvidence) -> Belief:
    outside = OUT_OF_MAP_SHARE if first.missing is None else START_OUTSIDE
    return Belief(first.time, (), np.zeros(0), 1 - outside, outside, {})


def _photos_of_targets(
    graph: PhotoGraph, targets: PhotoTable, evidence: FrameEvidence
) -> FloatArray:
    """Return (m,) how many photos each target stands for.

    That is more than 1 where a label has more photos without coordinates than are found by their
    labels. They are all in one place, so those that are no hits may stand for each other.
    """
    numbers = np.ones(len(targets))
    labelled = np.isnan(targets.latitudes) & (targets.places != None)  # noqa: E711
    if labelled.sum() < MAX_SAME_LABEL:
        return numbers
    hits = {hit.photo for hit in evidence.hits}
    is_hit = np.array([photo in hits for photo in targets.ids], dtype=bool)
    counts = graph.count_labels(set(targets.places[labelled].tolist()))
    for place, count in counts.items():
        members = labelled & (targets.places == place)
        others = members & ~is_hit
        unseen = max(0, count - int(members.sum()))
        numbers[others] += unseen / max(1, int(others.sum()))
    return numbers


def _gaussian(away: FloatArray, width: float) -> FloatArray:
    """Return (n,) or (n, m) weights of distances in metres; 1 for 0 m."""
    weights: FloatArray = np.exp(-0.5 * (np.minimum(away, 1e9) / width) ** 2)
    return weights


def _gaps_along(
    sources: PhotoTable, targets: PhotoTable, away: FloatArray, typical_speed_mps: float
) -> FloatArray:
    """Return (n, m) signed metres along the map's sequences; NaN where another way is shorter."""
    gaps = signed_gap_seconds(sources, targets) * typical_speed_mps
    located = ~np.isnan(sources.latitudes)[:, None] & ~np.isnan(targets.latitudes)
    gaps[located | (np.abs(gaps) > away)] = np.nan
    return gaps


def _are_siblings(sources: PhotoTable, targets: PhotoTable) -> NDArray[np.bool_]:
    """Return (n, m) whether the labels of two photos are paths with the same parent."""
    paths = [label_levels(place, True) for place in (*sources.places, *targets.places)]
    parents = np.array([path[1] if len(path) > 1 else "" for path in paths])
    first, second = parents[: len(sources), None], parents[None, len(sources) :]
    siblings: NDArray[np.bool_] = (first == second) & (first != "")
    return siblings


def _odometry_weights(away: FloatArray, odometry: Odometry) -> FloatArray:
    """Weigh distances by odometry. The distance between the ends may be shorter than the path."""
    width = np.hypot(odometry.distance_accuracy_m, SPACING_M)
    shorter = np.hypot(width, 0.3 * odometry.distance_m)
    difference = np.minimum(away, 1e9) - odometry.distance_m
    return _gaussian(difference / np.where(difference > 0, width, shorter), 1.0)


def _heading_weights(sources: PhotoTable, targets: PhotoTable, odometry: Odometry) -> FloatArray:
    """Return (n, m) weights of the changes of the heading; 1 where it is not known."""
    if odometry.heading_change_degrees is None:
        return np.ones((len(sources), len(targets)))
    turned = targets.headings[None, :] - sources.headings[:, None]
    turned = (turned - odometry.heading_change_degrees + 180) % 360 - 180
    fit = _gaussian(np.abs(turned), odometry.heading_accuracy_degrees)
    return np.where(np.isnan(turned), 1.0, HEADING_FLOOR + (1 - HEADING_FLOOR) * fit)


def _fix_reach_m(fix: PositionFix) -> float:
    return 3 * math.hypot(fix.accuracy_m, SPACING_M)


def _near_fix(graph: PhotoGraph, fix: PositionFix) -> tuple[PhotoTable, float]:
    return find_nearest(
        lambda reach, limit: graph.near(fix.latitude, fix.longitude, reach, limit),
        _fix_reach_m(fix),
        MAX_NEAR,
    )


def _excess(evidence: FrameEvidence, count: int) -> dict[str, float]:
    """Return by how much the probabilities of the hits exceed their prior."""
    prior = 1 / count
    return {h.photo: h.probability - prior for h in evidence.hits if h.probability > prior}


def _novelty(seen: dict[str, float], now: dict[str, float]) -> float:
    """Return the share of a frame's evidence that the frame before did not have."""
    if not seen or not now:
        return 1.0
    shared = sum(np.sqrt(value * seen.get(photo, 0.0)) for photo, value in now.items())
    return float(max(0.0, 1 - shared / np.sqrt(sum(now.values()) * sum(seen.values()))))


def _likelihoods(
    targets: PhotoTable, evidence: FrameEvidence, count: int
) -> tuple[FloatArray, float]:
    """Return the likelihoods of the targets and of any other photo; 1 on average over the map."""
    probability = {hit.photo: hit.probability for hit in evidence.hits}
    other = max(0.0, 1 - sum(probability.values())) / max(count - len(probability), 1)
    values = np.array([probability.get(photo, other) for photo in targets.ids], dtype=np.float64)
    return np.maximum(values * count, 1e-9), max(other * count, 1e-9)


def _place(photos: PhotoTable, probabilities: FloatArray) -> _Place | None:
    """Return the mean place around the most probable photo; None if it is in no sequence."""
    best = int(probabilities.argmax()) if len(probabilities) else -1
    if best < 0 or np.isnan(photos.seconds[best]) or not np.isnan(photos.latitudes[best]):
        return None
    around = np.abs(photos.seconds - photos.seconds[best]) <= WINDOW_SECONDS
    around &= photos.sequences == photos.sequences[best]
    total = float(probabilities[around].sum())
    seconds = float(probabilities[around] @ photos.seconds[around]) / max(total, 1e-12)
    return _Place(photos.sequences[best], seconds, total)


def _window_likelihoods(
    targets: PhotoTable, predicted: FloatArray, likelihoods: FloatArray
) -> FloatArray:
    """Return the likelihood of the window around each photo: the mean over its predicted photos.

    A window is what the map's sequence shows within WINDOW_SECONDS. A photo with coordinates, or
    without a sequence, is a window of its own.
    """
    means = likelihoods.copy()
    chained = np.isnan(targets.latitudes) & ~np.isnan(targets.seconds)
    for name in set(targets.sequences[chained].tolist()) - {None}:
        rows = np.flatnonzero(chained & (targets.sequences == name))
        rows = rows[np.argsort(targets.seconds[rows], kind="stable")]
        seconds = targets.seconds[rows]
        first = np.searchsorted(seconds, seconds - WINDOW_SECONDS, "left")
        last = np.searchsorted(seconds, seconds + WINDOW_SECONDS, "right")
        sums = np.zeros((2, len(rows) + 1))
        np.cumsum([predicted[rows], predicted[rows] * likelihoods[rows]], axis=1, out=sums[:, 1:])
        prior, joint = sums[:, last] - sums[:, first]
        means[rows] = np.where(prior > 1e-12, joint / np.maximum(prior, 1e-12), likelihoods[rows])
    return np.maximum(means, 1e-9)


def _learn_gain(belief: Belief, log_fit: float, weight: float, tracked: float) -> Belief:
    """Add a frame to the mean gain of the track; the oldest frames beyond the maximum fade.

    Args:
        belief: The belief after the frame.
        log_fit: Log-likelihood of the frame's evidence at the predicted places.
        weight: Share of the evidence that counts.
        tracked: Probability of the place; frames of unknown places say nothing about the gain.
    """
    before = min(belief.gain_weight, MAX_GAIN_WEIGHT)
    total = before + tracked * weight
    mean = (belief.gain * before + tracked * log_fit) / total
    return replace(belief, gain=max(0.0, mean), gain_weight=total)


def _fix_weights(
    targets: PhotoTable, fix: PositionFix, complete_m: float, count: int
) -> tuple[FloatArray, float]:
    """Return the likelihoods of a position fix for the targets and for any other photo.

    They are 1 on average over the map. Within `complete_m` of the fix, all photos are targets.
    """
    point = PhotoTable.of_rows([("", fix.latitude, fix.longitude, None, None, None, None)])
    chords = np.linalg.norm(unit_vectors(targets) - unit_vectors(point), axis=1) * EARTH_RADIUS_M
    # A Rayleigh distribution has 68 % within 1.51 standard deviations.
    weigh = partial(_gaussian, width=math.hypot(fix.accuracy_m / 1.51, SPACING_M))
    near = np.nan_to_num(weigh(chords))
    others = count - len(targets)
    ring, _ = weigh_rings(weigh, complete_m, _fix_reach_m(fix), 2)
    unseen = np.sum(chords <= complete_m) * ring - near[chords > complete_m].sum()
    unseen = float(np.clip(unseen, 0.0, max(others, 0)))
    total = float(near.sum()) + unseen
    # `near` is NaN-free, and a fix far from all photos says nothing but that it is wrong.
    scale = (1 - FIX_OUTLIERS) * (count / total if total > 1e-9 else 1.0)
    return FIX_OUTLIERS + scale * near, FIX_OUTLIERS + scale * unseen / max(others, 1)


def _kept(posterior: FloatArray, density: float) -> Indices:
    """Return the rows of the photos that keep a probability of their own."""
    order = np.argsort(-posterior, kind="stable")[:MAX_PHOTOS]
    tail = posterior.sum() - np.cumsum(posterior[order])
    kept = (posterior[order] > MIN_GAIN * density) & (tail > NEGLIGIBLE)
    kept[:ALWAYS_KEPT] = True
    return np.sort(order[kept])


def _backward(steps: Sequence[_Step], count: int) -> list[Belief]:
    """Run the backward pass, and multiply it with the forward beliefs."""
    smoothed: list[Belief] = []
    photos = np.ones(len(steps[-1].belief.photos)) if steps else np.zeros(0)
    elsewhere = outside = 1.0
    for index in range(len(steps) - 1, -1, -1):
        belief = steps[index].belief
        own = belief.probabilities * photos
        parts = belief.elsewhere * elsewhere, belief.outside * outside
        total = float(own.sum()) + sum(parts)
        smoothed.append(
            replace(
                belief,
                probabilities=own / total,
                elsewhere=parts[0] / total,
                outside=parts[1] / total,
            )
        )
        step = steps[index]
        message = step.weights * photos
        else_message = step.weight_elsewhere * elsewhere
        out_message = step.weight_outside * outside
        if index == 0:
            break
        before = steps[index - 1].belief
        kept = len(message)
        anywhere = (float(message.sum()) + (count - kept) * else_message) / count
        moved = step.kernel @ message + (1 - step.kernel.sum(axis=1)) * else_message
        carried = step.carried_away * anywhere + step.leaving * out_message
        elsewhere_after = _from_elsewhere(step, before, message, else_message, count)
        elsewhere = step.stay * elsewhere_after + carried
        photos = np.full(len(before.photos), elsewhere)  # those of deleted photos
        photos[step.sources] = step.stay * moved + carried
        outside = (1 - step.entering) * out_message + step.entering * anywhere
        scale = max(float(photos.max(initial=0.0)), elsewhere, outside)
        photos, elsewhere, outside = photos / scale, elsewhere / scale, outside / scale
    return smoothed[::-1]


def _from_elsewhere(
    step: _Step, before: Belief, message: FloatArray, else_message: float, count: int
) -> float:
    """Return the message to `elsewhere`, whose photos stay where they are."""
    sources = {before.photos[row] for row in step.sources.tolist()}
    is_new = np.array([photo not in sources for photo in step.belief.photos], dtype=bool)
    unseen = max(count - len(sources), 1)
    appeared = float(message[is_new].sum())
    return (appeared + max(unseen - int(is_new.sum()), 0) * else_message) / unseen
