"""Beliefs, evidence and motion: serialisation, limits, bad input."""

from __future__ import annotations

import json
import zlib

import numpy as np
import pytest

from shared.tracks.belief import FORMAT_VERSION, START_GAIN, Belief
from shared.tracks.evidence import FrameEvidence, frame_evidence, rank_shares
from shared.tracks.motion import MOTION_MODELS, motion_model
from tests.unit.tracks.maps import at


def belief(**changes: object) -> Belief:
    values: dict[str, object] = {
        "time": at(0),
        "photos": ("a", "b"),
        "probabilities": np.array([0.5, 0.25]),
        "elsewhere": 0.2,
        "outside": 0.05,
        "seen": {"a": 0.5},
    }
    return Belief(**(values | changes))  # type: ignore[arg-type]


def test_a_belief_survives_serialisation() -> None:
    restored = Belief.from_bytes(belief(status="tracking", frames=3).to_bytes())
    assert (restored.time, restored.photos) == (at(0), ("a", "b"))
    assert restored.probabilities.tolist() == [0.5, 0.25]
    assert (restored.elsewhere, restored.outside, restored.seen) == (0.2, 0.05, {"a": 0.5})
    assert (restored.status, restored.frames) == ("tracking", 3)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"x" * 10,
        zlib.compress(b"{}"),
        zlib.compress(b"[]"),
        b"x" * 1_000_001,
        belief(elsewhere=0.9).to_bytes(),
    ],
    ids=["empty", "damaged", "no version", "a list", "too long", "more than 1"],
)
def test_malformed_beliefs_are_an_error(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"belief|Belief"):
        Belief.from_bytes(data)


def test_a_belief_of_a_newer_release_is_an_error_that_names_both_formats() -> None:
    content = json.loads(zlib.decompress(belief().to_bytes()))
    newer = zlib.compress(json.dumps(content | {"version": FORMAT_VERSION + 1}).encode())
    message = f"format {FORMAT_VERSION + 1}; this release reads formats up to {FORMAT_VERSION}"
    with pytest.raises(ValueError, match=message):
        Belief.from_bytes(newer)


def test_a_belief_of_a_release_before_is_read_with_the_gain_and_pace_of_a_new_track() -> None:
    content = json.loads(zlib.decompress(belief(gain=2.0, gain_weight=50.0, pace=2.0).to_bytes()))
    del content["gain"], content["gain_weight"], content["pace"]
    older = zlib.compress(json.dumps(content | {"version": 1}).encode())
    assert (Belief.from_bytes(older).gain, Belief.from_bytes(older).pace) == (START_GAIN, 1.0)


def test_the_probabilities_of_a_frame_and_of_all_other_photos_add_up_to_one() -> None:
    shares, rest = rank_shares(np.array([0.9, 0.5, 0.4]), 1000)
    assert shares.sum() + rest == pytest.approx(1.0)
    evidence = frame_evidence(at(0), ["a", "b", "c"], [0.9, 0.5, 0.4], 1000)
    assert [hit.probability for hit in evidence.hits] == shares.tolist()
    assert shares[0] > shares[1] > shares[2] > 0


def test_equal_scores_say_nothing_about_the_hits() -> None:
    shares, rest = rank_shares(np.full(5, 0.3), 5)
    assert shares.tolist() == pytest.approx([0.2] * 5)
    assert rest == 0.0
    # Below the best tenth of a small map, the rank alone counts.
    shares, _ = rank_shares(np.linspace(1, 0, 40), 40)
    assert (np.diff(shares) < 0).all()
    assert rank_shares(np.zeros(0), 10)[1] == 1.0


def test_evidence_survives_serialisation() -> None:
    evidence = frame_evidence(at(0), ["a"], [0.9], 10)
    assert FrameEvidence.model_validate_json(evidence.model_dump_json()) == evidence
    of_an_earlier_release = evidence.model_dump(mode="json") | {"not_in_map": 0.02}
    assert FrameEvidence.model_validate(of_an_earlier_release) == evidence


@pytest.mark.parametrize("motion", ["", "fly", "nan", "-1", "0", "inf"])
def test_an_unknown_motion_is_an_error_that_lists_the_known_ones(motion: str) -> None:
    with pytest.raises(ValueError, match="walk, bicycle, car, train"):
        motion_model(motion)


def test_a_motion_is_a_name_or_a_maximum_speed() -> None:
    assert motion_model("car") is MOTION_MODELS["car"]
    assert motion_model("7.5").max_speed_mps == 7.5
    assert motion_model(5e-324).typical_speed_mps > 0, "distances are divided by it"
