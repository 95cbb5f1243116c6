"""The filter and the smoother against brute force over all paths of small hidden Markov models."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lab.evaluation.array_photo_graph import ArrayPhotoGraph
from shared.evaluation.places.levels import LevelScheme
from shared.evaluation.places.probability import OUT_OF_MAP_SHARE
from shared.geodesy import EARTH_RADIUS_M
from shared.tracks import filter as filter_module
from shared.tracks import photo_graph
from shared.tracks.belief import START_GAIN, Belief
from shared.tracks.evidence import FrameEvidence, Hit, Odometry, PositionFix
from shared.tracks.filter import (
    CHANCE_GAIN,
    ENTERING,
    KIDNAPPING_RATE,
    LEAVING,
    MAX_GAIN,
    NOVELTY_WEIGHT,
    OUTSIDE_GAIN,
    SPACING_M,
    TrackFilter,
)
from shared.tracks.motion import MOTION_MODELS, motion_model
from shared.tracks.photo_graph import PhotoTable
from shared.tracks.state import TrackState
from tests.unit.tracks.maps import at, frame, line_map, pointing_at, sequence_map

pytestmark = pytest.mark.numerics

COUNT = 4
METRES_PER_DEGREE = np.radians(EARTH_RADIUS_M)
WALK = MOTION_MODELS["walk"]


def random_frames(seed: int, steps: int) -> list[FrameEvidence]:
    rng = np.random.default_rng(seed)
    frames = []
    for step in range(steps):
        shares = rng.dirichlet(np.full(COUNT, 0.5)) * 0.98 + 0.02 / COUNT
        frames.append(frame(2.0 * step, shares.tolist()))
    return frames


def follow(track_filter: TrackFilter, frames: Iterable[FrameEvidence]) -> list[Belief]:
    """The beliefs after each of the frames."""
    beliefs: list[Belief] = []
    for each in frames:
        beliefs.append(track_filter.advance(beliefs[-1] if beliefs else None, each))
    return beliefs


def brute_force(frames: list[FrameEvidence]) -> NDArray[np.float64]:
    """(steps, photos + 1) smoothed probabilities over all paths; the last is "outside"."""
    east = 10.0 * np.subtract.outer(np.arange(COUNT), np.arange(COUNT)).T
    away, width = np.abs(east), np.hypot(SPACING_M, WALK.max_speed_mps * 2.0 / 2)
    start = np.append(np.full(COUNT, (1 - OUT_OF_MAP_SHARE) / COUNT), OUT_OF_MAP_SHARE)
    shown = np.array([[hit.probability for hit in f.hits] for f in frames])
    gains, velocities, belief = [], [], None
    for each in frames:
        gains.append(belief.gain if belief else START_GAIN)
        velocities.append(belief.velocity[1] * METRES_PER_DEGREE if belief else 0.0)
        belief = TrackFilter(line_map(COUNT), WALK).advance(belief, each)
    outside = np.exp(OUTSIDE_GAIN * np.maximum(0.0, np.minimum(gains, MAX_GAIN) - CHANCE_GAIN))
    likelihood = np.column_stack([shown * COUNT, outside])
    new = np.ones(len(frames))
    for step in range(1, len(frames)):
        now, before = (np.maximum(shown[n] - 1 / COUNT, 0) for n in (step, step - 1))
        if now.sum() > 0 and before.sum() > 0:
            novelty = 1 - np.sqrt(now * before).sum() / np.sqrt(now.sum() * before.sum())
            new[step] = min(1.0, NOVELTY_WEIGHT * novelty)
    moves = []
    for step in range(len(frames)):
        move = np.zeros((COUNT + 1, COUNT + 1))
        carried, leaving, entering = (
            rate * new[step] for rate in (KIDNAPPING_RATE, LEAVING, ENTERING)
        )
        # A first frame moves nothing: all photos are equally probable before it.
        kernel = np.exp(-0.5 * ((east - 2.0 * new[step] * velocities[step]) / width) ** 2)
        kernel[away > WALK.max_speed_mps * 2.0 + 3 * SPACING_M] = 0.0
        kernel /= kernel.sum(axis=1, keepdims=True)
        moving = np.minimum(1, 2.0 * WALK.max_speed_mps / (kernel * away).sum(axis=1))[:, None]
        kernel = moving * kernel + (1 - moving) * np.eye(COUNT)
        walked = np.eye(COUNT) if step == 0 else kernel
        move[:COUNT, :COUNT] = (1 - carried - leaving) * walked + carried / COUNT
        move[:COUNT, COUNT] = leaving
        move[COUNT, :COUNT] = entering / COUNT
        move[COUNT, COUNT] = 1 - entering
        moves.append(move)
    smoothed = np.zeros((len(frames), COUNT + 1))
    first = start @ moves[0]
    for path in itertools.product(range(COUNT + 1), repeat=len(frames)):
        probability = first[path[0]] * likelihood[0, path[0]] ** new[0]
        for step in range(1, len(frames)):
            probability *= moves[step][path[step - 1], path[step]]
            probability *= likelihood[step, path[step]] ** new[step]
        for step, state in enumerate(path):
            smoothed[step, state] += probability
    normalised: NDArray[np.float64] = smoothed / smoothed.sum(axis=1, keepdims=True)
    return normalised


@pytest.mark.parametrize("seed", range(2))
def test_the_forward_pass_is_that_of_the_hidden_markov_model(seed: int) -> None:
    frames = random_frames(seed, 5)
    track_filter, belief = TrackFilter(line_map(COUNT), WALK), None
    for step, each in enumerate(frames):
        belief = track_filter.advance(belief, each)
        expected = brute_force(frames[: step + 1])[-1]
        found = dict(zip(belief.photos, belief.probabilities, strict=True))
        assert [found[str(photo)] for photo in range(COUNT)] == pytest.approx(expected[:COUNT])
        assert belief.outside == pytest.approx(expected[COUNT])
        assert belief.elsewhere == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_forward_and_backward_together_are_those_of_the_hidden_markov_model(seed: int) -> None:
    frames = random_frames(seed, 5)
    smoothed = TrackFilter(line_map(COUNT), WALK).smooth(frames)
    for belief, expected in zip(smoothed, brute_force(frames), strict=True):
        found = dict(zip(belief.photos, belief.probabilities, strict=True))
        assert [found[str(photo)] for photo in range(COUNT)] == pytest.approx(expected[:COUNT])
        assert belief.outside == pytest.approx(expected[COUNT])


def test_a_camera_that_stands_still_learns_nothing_from_more_frames_of_the_same_view() -> None:
    track_filter = TrackFilter(line_map(20), WALK)
    first, *_, last = follow(track_filter, [pointing_at(7, 20, 0)] * 31)
    state, before = track_filter.state(last), track_filter.state(first)
    assert state.probability == pytest.approx(before.probability, abs=0.15)


def test_frames_that_follow_the_street_are_tracked_with_their_position_and_heading() -> None:
    track_filter = TrackFilter(line_map(200), motion_model(15.0))
    first, *_, last = follow(
        track_filter, (pointing_at(50 + step, 200, step, 0.3) for step in range(12))
    )
    state = track_filter.state(last)
    assert first.status == "converging"
    assert state.status == "tracking"
    assert state.photo in {"60", "61"}
    assert state.longitude == pytest.approx(61 * np.degrees(10 / 6_371_008.8), abs=2e-4)
    assert state.heading == 90.0
    assert state.probability > 0.9
    probabilities = [level.probability for level in state.levels]
    assert probabilities == sorted(probabilities)
    assert state.radius_68_m is not None
    assert state.radius_68_m <= 25.0


def test_a_kidnapped_camera_is_relocalised() -> None:
    track_filter = TrackFilter(line_map(500), motion_model(15.0))
    shown = [*range(50, 70), *range(400, 405)]
    beliefs = follow(
        track_filter, (pointing_at(photo, 500, step, 0.3) for step, photo in enumerate(shown))
    )
    assert str(track_filter.state(beliefs[19]).photo) in {"68", "69", "70"}
    assert beliefs[24].status == "tracking"
    assert str(track_filter.state(beliefs[24]).photo) in {"403", "404", "405"}


def test_a_camera_that_leaves_the_map_is_lost_and_nowhere_else() -> None:
    rng = np.random.default_rng(3)
    frames = [pointing_at(50 + step, 500, step, 0.3) for step in range(20)]
    elsewhere = rng.dirichlet(np.full(500, 0.05), 40) * 0.7
    frames += [frame(step, shares.tolist()) for step, shares in enumerate(elsewhere, 20)]
    beliefs = follow(TrackFilter(line_map(500), motion_model(15.0)), frames)
    statuses = [belief.status for belief in beliefs[20:]]
    assert statuses.index("lost") < 20
    assert "tracking" not in statuses[20:]
    assert beliefs[-1].outside > 0.5


def test_a_track_of_weak_evidence_measures_the_outside_by_its_own_level() -> None:
    """Frames that would be foreign in a ride of clear views are usual in one of dim views."""
    outside = {}
    for clear in (0.2, 0.02):
        shown = [clear] * 40 + [0.02] * 20
        frames = (pointing_at(50 + step, 500, step, share) for step, share in enumerate(shown))
        *_, last = follow(TrackFilter(line_map(500), motion_model(15.0)), frames)
        outside[clear] = last.outside
    assert outside[0.2] > 3 * outside[0.02]


def test_the_gain_is_learnt_from_tracked_frames_and_follows_the_light() -> None:
    shown = [0.5] * 100 + [0.05] * 300
    frames = (pointing_at(50 + step, 500, step, share) for step, share in enumerate(shown))
    beliefs = follow(TrackFilter(line_map(500), motion_model(15.0)), frames)
    gains = [belief.gain for belief in beliefs]
    assert gains[0] < 1.0 < 2.0 < gains[99]
    assert gains[399] < 0.8 * gains[99]


def test_a_frame_counts_by_the_share_of_its_evidence_that_is_new() -> None:
    track_filter = TrackFilter(line_map(100), WALK)
    first = track_filter.advance(None, pointing_at(20, 100, 0, 0.4))
    odds = []
    for second in (20, 21):  # the same view again, and the next one
        belief = track_filter.advance(first, pointing_at(second, 100, 0.1, 0.4))
        shown = sum(belief.probabilities[belief.photos.index(each)] for each in ("20", "21"))
        odds.append(shown / (1 - shown))
    assert odds[1] > 2 * odds[0]


def test_odometry_decides_between_two_directions_of_the_same_view() -> None:
    track_filter = TrackFilter(line_map(200), motion_model(40.0))
    belief = track_filter.advance(None, pointing_at(100, 200, 0, 0.9))
    after = pointing_at(100, 200, 1, 0.9)
    still = after.model_copy(
        update={"odometry": Odometry(distance_m=0.0, distance_accuracy_m=1.0), "hits": ()}
    )
    moved = after.model_copy(
        update={"odometry": Odometry(distance_m=60.0, distance_accuracy_m=1.0), "hits": ()}
    )
    at_rest, away = (track_filter.advance(belief, each) for each in (still, moved))

    def at_start(after_frame: Belief) -> float:
        return float(after_frame.probabilities[after_frame.photos.index("100")])

    assert at_start(at_rest) > 3 * at_start(away)


def test_a_position_fix_finds_photos_that_no_hit_points_to() -> None:
    fix = PositionFix(latitude=0.0, longitude=np.degrees(2000 / 6_371_008.8), accuracy_m=8.0)
    track_filter = TrackFilter(line_map(300), WALK)
    *_, last = follow(track_filter, (FrameEvidence(time=at(step), fix=fix) for step in range(4)))
    state = track_filter.state(last)
    assert state.status == "tracking"
    assert state.photo in {"199", "200", "201"}


def test_photos_that_were_deleted_between_two_frames_lose_their_probability() -> None:
    belief = TrackFilter(line_map(30), WALK).advance(None, pointing_at(29, 30, 0, 0.9))
    after = TrackFilter(line_map(10), WALK).advance(belief, pointing_at(3, 10, 1, 0.3))
    assert set(after.photos) <= {str(number) for number in range(10)}
    total = after.probabilities.sum() + after.elsewhere + after.outside
    assert total == pytest.approx(1.0)


def test_a_frame_older_than_the_belief_is_an_error() -> None:
    track_filter = TrackFilter(line_map(5), WALK)
    belief = track_filter.advance(None, pointing_at(1, 5, 10))
    with pytest.raises(ValueError, match="older"):
        track_filter.advance(belief, pointing_at(1, 5, 9))


def test_sequences_without_coordinates_are_followed_along_their_own_time() -> None:
    rng = np.random.default_rng(0)
    track_filter, belief = TrackFilter(sequence_map(1000), MOTION_MODELS["train"]), None
    right = 0
    for step in range(60):
        # One frame in three shows its own photo best, the others show any.
        shown = 300 + step if rng.uniform() < 0.34 else int(rng.integers(1000))
        hits = tuple(
            Hit(photo=str(photo), score=probability, probability=probability)
            for photo, probability in ((shown, 0.25), (int(rng.integers(1000)), 0.05))
        )
        belief = track_filter.advance(belief, FrameEvidence(time=at(step), hits=hits))
        photo = track_filter.state(belief).photo
        right += photo is not None and abs(int(photo) - 300 - step) <= 10
    assert right > 40


def follow_film(shown: list[int]) -> tuple[list[int], Belief]:
    """Follow a ride along a film whose frames resemble the photos around the right one."""
    rng = np.random.default_rng(1)
    scheme = LevelScheme(labels_are_paths=False, radii_m=(200.0,))
    track_filter = TrackFilter(sequence_map(400), MOTION_MODELS["train"], scheme)
    frames = []
    places, noise = np.arange(400), rng.normal(size=(400, 400))
    for step, photo in enumerate(shown):
        # The same photo is the same view again, with the same resemblances.
        likeness = np.exp(4 * np.exp(-0.5 * ((places - photo) / 1.5) ** 2) + 0.8 * noise[photo])
        frames.append(frame(step, (likeness / likeness.sum()).tolist()))
    beliefs = follow(track_filter, frames)
    return [int(track_filter.state(each).photo or -1) for each in beliefs], beliefs[-1]


@pytest.mark.parametrize("pace", [0.5, 2.5, -1.0])
def test_the_pace_along_a_sequence_is_learned_within_the_limit_of_the_motion(pace: float) -> None:
    shown = [int(200 - 60 * pace + pace * step) for step in range(120)]
    found, belief = follow_film(shown)
    assert np.mean(np.abs(np.array(found) - shown)[30:] <= 5) > 0.9
    assert belief.pace == pytest.approx(pace, abs=0.4)


def test_a_camera_that_stands_is_not_moved_on_by_the_pace_it_had() -> None:
    shown = [*range(50, 110), *[110] * 30, *range(110, 140)]
    found, belief = follow_film(shown)
    assert np.mean(np.abs(np.array(found) - shown)[30:] <= 5) > 0.95
    assert belief.status == "tracking"


def test_frames_that_mislead_to_the_same_photos_of_a_sequence_are_not_tracked() -> None:
    """Each frame is new, but those of a minute all resemble the same few photos best."""
    rng = np.random.default_rng(2)
    track_filter = TrackFilter(
        sequence_map(400),
        MOTION_MODELS["train"],
        LevelScheme(labels_are_paths=False, radii_m=(200.0,)),
    )
    frames = []
    for step in range(180):
        lure = 100 + 90 * (step // 60)
        likeness = np.exp(rng.normal(size=400))
        likeness[lure - 2 : lure + 3] *= rng.uniform(10, 60, 5)
        frames.append(frame(step, (likeness / likeness.sum()).tolist()))
    beliefs = follow(track_filter, frames)
    assert [belief.status for belief in beliefs].count("tracking") < 9
    assert track_filter.state(beliefs[-1]).probability < 0.5


def follow_rooms(
    shown: list[int], missing: float | None = None
) -> tuple[TrackFilter, list[Belief]]:
    """Follow a walk through a house of 4 floors with 3 rooms each, of which 10 photos show each."""
    rng = np.random.default_rng(4)
    graph = ArrayPhotoGraph(
        PhotoTable.of_rows(
            (str(n), None, None, None, f"house/{n // 30}/{n // 10 % 3}", None, None)
            for n in range(120)
        )
    )
    scheme = LevelScheme(labels_are_paths=True, radii_m=(25.0,))
    track_filter, frames = TrackFilter(graph, WALK, scheme), []
    for second, room in enumerate(shown):
        shares = np.full(120, 0.5 / 110)
        shares[10 * room : 10 * room + 10] = 0.5 * rng.dirichlet(np.full(10, 0.3))
        frames.append(frame(second, shares.tolist()).model_copy(update={"missing": missing}))
    return track_filter, follow(track_filter, frames)


def test_frames_that_agree_on_a_room_are_not_tracked_if_each_looks_foreign_to_the_map() -> None:
    shown = [7] * 40
    statuses = {
        missing: [belief.status for belief in follow_rooms(shown, missing)[1]]
        for missing in (None, -0.5, 0.5)
    }
    assert statuses[None].count("tracking") > 30
    assert statuses[-0.5].count("tracking") > 25
    assert statuses[0.5].count("tracking") == 0
    track_filter, beliefs = follow_rooms(shown, 0.5)
    assert beliefs[-1].outside > 0.9
    frames = [frame(n, [1 / 120] * 120).model_copy(update={"missing": 0.5}) for n in range(40)]
    assert {state.status for state in track_filter.smoothed_states(frames)} == {"lost"}


def test_a_camera_goes_on_to_a_room_of_its_floor_sooner_than_to_one_of_another_floor() -> None:
    changed = {}
    for room in (1, 4):  # on the same floor, and on the next one
        track_filter, beliefs = follow_rooms([0] * 15 + [room] * 10)
        found = [track_filter.state(belief).place for belief in beliefs[15:]]
        changed[room] = found.index(f"house/{room // 3}/{room % 3}")
    assert changed[1] < changed[4]


def test_a_camera_is_expected_to_go_on_as_it_did_unless_it_sees_nothing_new() -> None:
    track_filter = TrackFilter(line_map(200), motion_model(15.0))
    frames = (pointing_at(50 + step, 200, step, 0.3) for step in range(20))
    belief = follow(track_filter, frames)[-1]
    assert belief.velocity[1] * METRES_PER_DEGREE == pytest.approx(10.0, abs=3.0)

    def mean_photo(after: Belief) -> float:
        return float(after.probabilities @ [int(photo) for photo in after.photos])

    before, blind, still = mean_photo(belief), FrameEvidence(time=at(20)), belief
    assert mean_photo(track_filter.advance(belief, blind)) > before + 0.5
    for step in range(20, 50):
        still = track_filter.advance(still, pointing_at(69, 200, step, 0.3))
    assert track_filter.state(still).photo in {"68", "69", "70"}


@pytest.mark.parametrize("seed", range(8))
def test_probabilities_add_up_to_one_for_any_times_odometry_and_hits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = line_map(60) if seed % 2 else sequence_map(60)
    track_filter, belief, seconds = TrackFilter(graph, motion_model("car")), None, 0.0
    for _ in range(15):
        seconds += float(rng.choice([0.0, 1e-6, 0.03, 1.0, 60.0, 1e6, 1e9]))
        shares = rng.dirichlet(np.full(8, 0.2)) * rng.uniform(0, 1)
        photos = rng.choice(90, size=7, replace=False)  # some are not in the map
        evidence = FrameEvidence(
            time=at(seconds),
            hits=tuple(
                Hit(photo=str(photo), score=share, probability=min(1.0, share))
                for photo, share in zip(photos.tolist(), shares.tolist(), strict=False)
            ),
            odometry=Odometry(
                distance_m=float(rng.choice([0.0, 1e-9, 5.0, 1e6])),
                distance_accuracy_m=float(rng.choice([1e-9, 1.0, 1e6])),
                heading_change_degrees=float(rng.choice([-360.0, 0.0, 90.0])),
            )
            if rng.uniform() < 0.5
            else None,
            fix=PositionFix(
                latitude=float(rng.choice([0.0, 90.0])), longitude=180.0, accuracy_m=1e-9 + 50
            )
            if rng.uniform() < 0.3
            else None,
        )
        belief = track_filter.advance(belief, evidence)
        total = float(belief.probabilities.sum()) + belief.elsewhere + belief.outside
        assert total == pytest.approx(1.0)
        assert (belief.probabilities >= 0).all()
        assert 0 <= track_filter.state(belief).probability <= 1
        assert len(belief.to_bytes()) < 1_000_000


def test_the_belief_does_not_depend_on_how_large_the_map_beyond_reach_is() -> None:
    for count in (300, 3000):
        track_filter, belief = TrackFilter(line_map(count), motion_model(15.0)), None
        for step in range(10):
            evidence = pointing_at(50 + step, 100, step, 0.5)
            belief = track_filter.advance(belief, replace_hits(evidence, 20))
        assert belief is not None
        assert len(belief.photos) <= 60


def replace_hits(evidence: FrameEvidence, count: int) -> FrameEvidence:
    """Keep the most probable hits of a frame."""
    hits = sorted(evidence.hits, key=lambda hit: -hit.probability)[:count]
    return evidence.model_copy(update={"hits": tuple(hits)})


def test_the_status_of_a_smoothed_state_follows_from_its_own_probability() -> None:
    track_filter = TrackFilter(line_map(50), WALK)
    frames = [pointing_at(7 + step, 50, step) for step in range(8)]
    belief, live = None, []
    for each in frames:
        belief = track_filter.advance(belief, each)
        live.append(track_filter.state(belief))
    smoothed = track_filter.smoothed_states(frames)
    assert (live[0].status, smoothed[0].status) == ("converging", "tracking")
    assert all(state.probability >= 0.8 for state in smoothed)
    assert smoothed[-1].status == live[-1].status


def test_smoothing_of_no_frames_is_empty() -> None:
    assert TrackFilter(line_map(3)).smooth([]) == []


def test_a_belief_survives_its_serialisation_between_two_frames() -> None:
    track_filter = TrackFilter(line_map(50), WALK)
    belief = track_filter.advance(None, pointing_at(7, 50, 0))
    restored = type(belief).from_bytes(belief.to_bytes())
    again, direct = (
        track_filter.advance(each, pointing_at(8, 50, 1)) for each in (restored, belief)
    )
    assert again.photos == direct.photos
    assert again.probabilities.tolist() == direct.probabilities.tolist()
    assert replace(again, photos=(), probabilities=np.zeros(0), seen={}).time == direct.time


def test_frames_in_a_map_without_photos_are_smoothed_to_elsewhere() -> None:
    frames = [frame(0.0, []), frame(1.0, [])]
    for belief in TrackFilter(line_map(0), WALK).smooth(frames):
        assert belief.photos == ()
        assert belief.elsewhere + belief.outside == pytest.approx(1)


def grid_map(*, is_located: bool) -> ArrayPhotoGraph:
    """A square of 30 x 30 photos 10 m apart; or 180 photos of each of five halls."""
    degrees = np.degrees(10.0 / EARTH_RADIUS_M)
    return ArrayPhotoGraph(
        PhotoTable.of_rows(
            (str(row), row // 30 * degrees, row % 30 * degrees, None, None, None, None)
            if is_located
            else (str(row), None, None, None, f"hall {row // 180}", None, None)
            for row in range(900)
        )
    )


@pytest.mark.parametrize(
    ("is_located", "accuracy_m"),
    [(True, None), (True, 60.0), (True, 100_000.0), (False, None)],
    ids=["coordinates", "a fix of 60 m", "a fix of 100 km", "labels"],
)
def test_photos_that_are_weighed_together_lead_to_the_place_that_they_lead_to_one_by_one(
    monkeypatch: pytest.MonkeyPatch, is_located: bool, accuracy_m: float | None
) -> None:
    rng = np.random.default_rng(0)
    shown = [310 + 30 * step if is_located else 400 + step for step in range(8)]
    frames = []
    for step, right in enumerate(shown):
        others = dict.fromkeys(rng.choice(900, 40, replace=False).tolist(), 0.01)
        hits = tuple(
            Hit(photo=str(photo), score=probability, probability=probability)
            for photo, probability in (others | {right: 0.08}).items()
        )
        fix = None
        if accuracy_m is not None:
            fix = PositionFix(latitude=0.001, longitude=0.001, accuracy_m=accuracy_m)
        frames.append(FrameEvidence(time=at(20 * step), hits=hits, fix=fix))
    states: dict[int, list[TrackState]] = {}
    for limit in (900, 100):
        monkeypatch.setattr(filter_module, "MAX_NEAR", limit if is_located else 900)
        for module in (filter_module, photo_graph):
            monkeypatch.setattr(module, "MAX_SAME_LABEL", limit)
        track_filter = TrackFilter(grid_map(is_located=is_located), WALK)
        states[limit] = [track_filter.state(belief) for belief in track_filter.smooth(frames)]
    for one_by_one, together in zip(states[900], states[100], strict=True):
        assert together.photo == one_by_one.photo
        assert together.probability == pytest.approx(one_by_one.probability, abs=0.15)
        assert together.outside == pytest.approx(one_by_one.outside, abs=0.01)
