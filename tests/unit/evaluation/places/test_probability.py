"""From a ranking to levels with probabilities: labels as paths, circles, and when to answer."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from services.steward.map_evaluation import answers_less
from shared.errors import Unprocessable
from shared.evaluation.calibration import expected_calibration_error
from shared.evaluation.places.evidence import PhotoLocation, RankedPhoto
from shared.evaluation.places.figures import PlaceEvaluation, evaluate_places
from shared.evaluation.places.fit import (
    MapScores,
    PlaceSample,
    fit_place_model,
    missing_place_table,
)
from shared.evaluation.places.levels import (
    FEATURES,
    MATCH_FEATURES,
    CandidateLevel,
    FloatArray,
    LevelScheme,
    candidate_levels,
    shared_neighbours,
)
from shared.evaluation.places.probability import (
    ELSEWHERE_SHARE,
    MIN_LABELLED_QUERIES,
    Background,
    Elsewhere,
    MapExtent,
    PlaceModel,
    error_radius_m,
    shipped_prior,
)
from shared.evaluation.places.samples import IndexRanking, OwnPhotoSampler
from shared.evaluation.places.thresholds import CERTAINTIES, HeldOutEstimate, choose_threshold
from shared.geodesy import distance_m
from shared.place_paths import is_within_level, label_levels, look_like_paths

pytestmark = pytest.mark.numerics

PATHS = LevelScheme(labels_are_paths=True, radii_m=(25.0, 100.0))
PLAIN = LevelScheme(labels_are_paths=False, radii_m=(25.0, 100.0))
DEGREE_M = 111_195.0
SCORES = MapScores(0.5, Background(mean=0.0, deviation=0.25))


def label(place: str | None) -> PhotoLocation:
    return PhotoLocation(None, None, place)


def north(metres: float, place: str | None = None) -> PhotoLocation:
    return PhotoLocation(45.0 + metres / DEGREE_M, 7.0, place)


def ranking(*pairs: tuple[float, PhotoLocation]) -> list[RankedPhoto]:
    return [RankedPhoto(score, location) for score, location in pairs]


def places(ranked: list[RankedPhoto], scheme: LevelScheme = PATHS) -> list[str | None]:
    return [level.place for level in candidate_levels(ranked, [], scheme, 0.5, 25.0)]


# --- labels ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "levels"),
    [
        ("tower/floor 7/lift", ("tower/floor 7/lift", "tower/floor 7", "tower")),
        ("tower", ("tower",)),
        ("a//b", ("a//b", "a")),
        ("a/ /b", ("a/ /b", "a")),
        ("/a/", ("/a",)),
        ("//", ()),
        (None, ()),
    ],
)
def test_levels_of_a_path_are_its_prefixes_that_end_in_a_name(
    text: str | None, levels: tuple[str, ...]
) -> None:
    assert label_levels(text, is_path=True) == levels


@pytest.mark.parametrize(
    ("labels", "are_paths"),
    [
        (["tower/7/lift", "tower/7/hall", "tower/8/lift"], True),
        (["tower/7/lift", "tower/8/lift", "garage"], True),
        (["tower/7", "station/1", "harbour/2"], False),
        (["room 1", "room 2", "tower/7/lift", "tower/7/hall"], False),
        (["24/7", "cafe / bar", "hall"], False),
        (["/tower", "/station"], False),
        (["tower/7"], False),
        ([], False),
    ],
)
def test_labels_look_like_paths_if_most_have_levels_and_two_share_the_first(
    labels: list[str], are_paths: bool
) -> None:
    assert look_like_paths(labels) is are_paths


def test_every_label_lies_within_its_levels_and_not_within_names_that_begin_alike() -> None:
    for text in ("a", "a//b", "/a/b/", "a/ /b"):
        assert all(is_within_level(text, level) for level in label_levels(text, is_path=True))
    assert not is_within_level("tower/floor 70", "tower/floor 7")
    assert label_levels("a/b", is_path=False) == ("a/b",), "what is no path is its only level"


def test_each_level_lies_inside_the_coarser_one_and_the_finest_is_where_most_labels_end() -> None:
    ranked = ranking((0.9, label("b/1/x")), (0.88, label("a/1/x")), (0.87, label("a/1/x")))
    assert places(ranked) == ["a/1/x", "a/1", "a"]
    assert places(ranking((0.9, label("a/1/x")), (0.5, label("a/1/y"))), PLAIN) == ["a/1/x"]
    ranked = ranking((0.9, label("a/1")), (0.9, label("a/1")), (0.9, label("a/1/x")))
    assert places(ranked) == ["a/1", "a"]
    assert places(ranked[:1] + ranked[2:] * 2) == ["a/1/x", "a/1", "a"]


def test_photos_without_labels_have_no_vote_and_no_level() -> None:
    assert places(ranking((0.9, label(None)), (0.1, label("a")))) == ["a"]
    assert places(ranking((0.9, label(None)), (0.8, label("//")))) == []
    assert candidate_levels([], [], PATHS, 0.5, 25.0) == []


def test_labels_decide_in_a_map_of_paths_and_coordinates_in_others() -> None:
    """The label and the coordinates of these photos disagree: they are 5 km apart."""
    ranked = ranking((0.9, north(0, "a/x")), (0.8, north(5000, "a/x")))
    assert places(ranked) == ["a/x", "a"]
    circles = candidate_levels(ranked, [], PLAIN, 0.5, 25.0)
    assert [level.radius_m for level in circles] == [25.0, 100.0]
    assert circles[0].contains(north(10))
    assert not circles[0].contains(north(5000, "a/x"))


def test_a_truth_that_is_coarser_than_a_level_does_not_judge_it() -> None:
    level = CandidateLevel(place="a/1/x", is_path=True)
    truths = ("a/1/x", "a/1/x/shelf", "a/1/y", "a/1", "b", None, "//")
    assert [level.is_right(label(truth)) for truth in truths] == [
        True, True, False, None, False, None, None,
    ]  # fmt: skip
    circle = CandidateLevel(latitude=45.0, longitude=7.0, radius_m=25.0)
    truths_m = [circle.is_right(spot) for spot in (north(20), north(30), label("a"))]
    assert truths_m == [True, False, None]


def test_thousands_of_labels_have_their_levels() -> None:
    ranked = ranking(*((1 - n / 1e4, label(f"a/{n % 7}/{n}")) for n in range(5000)))
    assert places(ranked)[-1] == "a"


# --- probabilities ---------------------------------------------------------------------------


def test_the_prior_orders_a_clear_and_an_unclear_ranking_and_answers_neither() -> None:
    clear = ranking(
        *((0.9 - n / 100, label("a/1/x")) for n in range(10)),
        *((0.1, label("b/1/x")) for _ in range(40)),
    )
    unclear = ranking(*((0.3 - n / 1e3, label(f"{n}/1/x")) for n in range(50)))
    sure, unsure = (PlaceModel().estimate(r, r[1:], PATHS, 0.95, 25.0) for r in (clear, unclear))
    assert sure is not None
    assert unsure is not None
    assert sure.probabilities[0] > 0.6 > 0.45 > unsure.probabilities[0]
    assert sure.not_in_map == unsure.not_in_map == ELSEWHERE_SHARE
    assert (sure.answer, unsure.answer) == (None, None)
    fitted = PlaceModel(source="own_photos", own_photos=20, spread=0.05)
    answered = fitted.estimate(clear, clear[1:], PATHS, 0.5, 25.0)
    assert answered is not None
    assert answered.answer == 0
    scores = (0.94, 0.96, 0.9999)
    leads = [fitted.may_lack_place(answered, score, ELSEWHERE_SHARE) for score in scores]
    assert leads == [False, True, False], (
        "a photo without a place leads by the spread; no copy does"
    )


def test_places_outside_the_finest_level_share_what_it_leaves_and_none_exceeds_it() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        scores = np.sort(rng.random(40))[::-1].tolist()
        labels = [label(f"{a}/1") for a in rng.integers(0, 8, 40)]
        spots = [north(1000.0 * a) for a in rng.integers(0, 8, 40)]
        for scheme, locations in ((PATHS, labels), (PLAIN, spots)):
            ranked = ranking(*zip(scores, locations, strict=True))
            estimate = PlaceModel().estimate(ranked, ranked[1:], scheme, 0.9, 25.0)
            assert estimate is not None
            places = dict(zip(locations, estimate.match_probabilities, strict=True))
            assert [places[r.location] for r in ranked] == pytest.approx(
                estimate.match_probabilities
            ), "photos of one place are equally probable"
            assert max(places.values()) == estimate.probabilities[0]
            assert sum(places.values()) + estimate.not_in_map <= 1 + 1e-9


def test_a_match_without_a_location_has_its_own_votes_only() -> None:
    nowhere = PhotoLocation(None, None, None)
    spots = (label("a/1"), nowhere, nowhere, label("b/1"), label("b/1"))
    ranked = ranking(*((0.9 - n / 100, spot) for n, spot in enumerate(spots)))
    estimate = PlaceModel().estimate(ranked, ranked[1:], PATHS, 0.9, 25.0)
    assert estimate is not None
    _, one, other, *places = estimate.match_probabilities
    assert one > other > 0
    assert places[0] == places[1]


def test_the_error_radius_lies_between_the_levels_that_enclose_its_share() -> None:
    circles = [CandidateLevel(latitude=45.0, longitude=7.0, radius_m=r) for r in (25.0, 100.0)]
    assert error_radius_m(circles, [0.5, 0.9], 0.68) == pytest.approx(25 + 75 * 0.18 / 0.4)
    assert error_radius_m(circles, [0.8, 0.9], 0.68) == pytest.approx(25 * 0.68 / 0.8)
    assert error_radius_m(circles, [0.5, 0.9], 0.95) is None
    assert error_radius_m([CandidateLevel(place="a")], [0.99], 0.68) is None


def test_an_answer_is_the_finest_level_over_the_threshold_if_the_query_is_in_the_map() -> None:
    model = PlaceModel(source="own_photos", thresholds=(0.9,) * len(CERTAINTIES))
    assert model.answer([0.91, 0.96], 0.04, 0.95) == 0
    assert model.answer([0.91, 0.92], 0.08, 0.95) is None
    assert model.answer([0.5, 0.91], 0.04, 0.95) == 1
    assert model.answer([0.5, 0.89], 0.04, 0.95) == 1  # the whole map
    without_thresholds = PlaceModel(source="own_photos")
    assert without_thresholds.answer([0.94, 0.96], 0.04, 0.95) == 1  # the certainty is one
    assert [model.is_in_map(missing) for missing in (0.05, 0.06, 0.5, 0.51)] == [
        True, None, None, False,
    ]  # fmt: skip


def test_the_threshold_is_the_lowest_with_the_certainty_as_share_of_right_answers() -> None:
    """Answers of both levels count together: the sure ones make up for those near the threshold."""
    sure = [held_out([0.99, 0.99], [True, True]) for _ in range(90)]
    unsure = [held_out([0.1, 0.86 + n / 1000], [False, n % 2 == 0]) for n in range(20)]
    found = choose_threshold([*sure, *unsure], 0.95)
    assert 0.86 < found < 0.95
    answered = [s for s in unsure if s.probabilities[1] >= found]
    wrong = sum(not s.is_right[1] for s in answered)
    assert (wrong + 1) / (len(sure) + len(answered) + 1) <= 0.05
    overconfident = [held_out([0.1, 0.91 + n / 1000], [False, n % 2 == 0]) for n in range(20)]
    assert choose_threshold(overconfident, 0.95) == 0.95


def test_where_no_sample_is_the_stated_probabilities_choose_the_threshold() -> None:
    sure = held_out([0.99, 0.99], [True, True])
    for samples in ([sure] * 90, [sure] * 5, []):
        assert choose_threshold(samples, 0.95) == pytest.approx(0.9)
    assert choose_threshold([], 0.99) == pytest.approx(0.98)


# --- elsewhere -------------------------------------------------------------------------------


def of_score(best_score: float, rival_score: float = 0.0) -> list[CandidateLevel]:
    features = np.zeros(len(FEATURES))
    return [CandidateLevel("a", features=features, best_score=best_score, rival_score=rival_score)]


def test_the_last_level_is_the_whole_map_and_adds_up_to_one_with_not_in_this_map() -> None:
    far = [north(0), north(400)]
    extent = MapExtent.of(far, PLAIN)
    assert extent.diameter_m == pytest.approx(400, abs=1)
    circles = [
        CandidateLevel(
            latitude=45.0, longitude=7.0, radius_m=r, features=np.zeros(len(FEATURES)), best_score=1
        )
        for r in (25.0, 100.0, 500.0, 2000.0)
    ]
    levels = extent.end_levels(circles)
    assert [level.radius_m for level in levels] == [25.0, 100.0, extent.diameter_m]
    assert [level.is_whole_map for level in levels] == [False, False, True]
    model = PlaceModel(
        source="own_photos",
        own_photos=10_000,
        extent=extent,
        elsewhere=Elsewhere(
            coefficients=(1.0, -2.0, 0.0),
            matched=(0.0,) * 4,
            background=Background(mean=0.0, deviation=1.0),
        ),
    )
    probabilities, missing = model.probabilities(levels)
    assert probabilities == sorted(probabilities)
    assert probabilities[-1] + missing == pytest.approx(1)
    for share in (0.01, 0.33, 0.9):
        odds = share / (1 - share) * np.exp(1 - 2)
        assert model.probabilities(levels, share)[1] == pytest.approx(odds / (1 + odds))


@pytest.mark.parametrize(
    "points",
    [
        [(-17.0, 179.99), (-17.0, -179.99), (-17.0, 179.9999), (-17.0, -179.9999)],
        [(89.9, 0.0), (89.9, 180.0), (90.0, 90.0)],
        [(48.9, 2.3), (-33.9, 151.2), (19.7, -155.1), (-43.5, 172.6)],
        [(45.0, 7.0), (45.0, 7.0)],
    ],
)
def test_no_two_photos_are_farther_apart_than_the_diameter(
    points: list[tuple[float, float]],
) -> None:
    diameter_m = MapExtent.of([PhotoLocation(*each, None) for each in points], PLAIN).diameter_m
    farthest_m = max(distance_m(*one, *other) for one in points for other in points)
    assert diameter_m is not None
    assert farthest_m <= diameter_m + 1e-6
    assert diameter_m <= 2 * farthest_m


def test_the_whole_map_is_named_by_the_label_that_all_photos_share() -> None:
    floors = [label("tower/1/hall"), label("tower/2/hall")]
    levels = [CandidateLevel(place=p, is_path=True) for p in ("tower/1/hall", "tower/1", "tower")]
    one_tower = MapExtent.of(floors, PATHS).end_levels(levels)
    assert [(level.place, level.is_whole_map) for level in one_tower] == [
        ("tower/1/hall", False), ("tower/1", False), ("tower", True),
    ]  # fmt: skip
    two = MapExtent.of([*floors, label("mall/1/hall")], PATHS).end_levels(levels)
    assert [(level.place, level.is_whole_map) for level in two][2:] == [
        ("tower", False), (None, True),
    ]  # fmt: skip


def test_a_map_with_a_photo_that_has_no_coordinates_has_no_radius() -> None:
    extent = MapExtent.of([north(0), north(10), label("hall")], PLAIN)
    circles = [CandidateLevel(latitude=45.0, longitude=7.0, radius_m=r) for r in (25.0, 100.0)]
    levels = extent.end_levels(circles)
    assert [(level.latitude, level.radius_m, level.is_whole_map) for level in levels] == [
        (45.0, 25.0, False), (45.0, 100.0, False), (None, None, True),
    ]  # fmt: skip


def matched_level(support: float) -> list[CandidateLevel]:
    features = np.append(np.zeros(len(FEATURES)), [support / 100, 0, 0, 0, 0])
    return [replace(of_score(0.12)[0], features=features)]


def test_what_all_photos_of_a_map_show_does_not_say_that_it_has_a_place() -> None:
    """Such as the vehicle that the camera is mounted on, or the black around a round picture."""
    known = shipped_prior().elsewhere["efficientnet-lite0-vlad128"]
    ordinary = known.of_map(Background.of([-0.04, 0.04] * 50, [8.0] * 95 + [300.0] * 5))
    assert ordinary == known
    of_vehicle = known.of_map(Background.of([-0.04, 0.04] * 50, [8.0] * 60 + [300.0] * 40))
    assert of_vehicle.probability(matched_level(300.0), 0.33) == pytest.approx(
        known.probability(of_score(0.12), 0.33)
    )
    of_round_pictures = known.of_map(Background.of([-0.086, 0.086] * 50))
    assert of_round_pictures.probability(of_score(0.2), 0.33) == pytest.approx(
        known.probability(of_score(0.1), 0.33)
    )


def test_the_more_similar_the_best_photo_and_the_less_its_rivals_the_less_is_it_elsewhere() -> None:
    known = shipped_prior().elsewhere["efficientnet-lite0-vlad128"]
    by_score = [known.probability(of_score(score), 0.33) for score in (0.03, 0.1, 0.15, 0.3)]
    assert by_score == sorted(by_score, reverse=True)
    assert by_score[0] > 0.8
    assert by_score[-1] < 0.01
    by_rivals = [known.probability(of_score(0.12, rival), 0.33) for rival in (0.0, 0.1, 0.2)]
    assert by_rivals == sorted(by_rivals)
    matched = [matched_level(support) for support in (5.0, 10.0, 100.0)]
    by_matches = [known.probability(level, 0.33) for level in matched]
    assert by_matches == sorted(by_matches, reverse=True)
    assert by_matches[-1] < 0.01


def test_an_extractor_of_unknown_scores_learns_from_photos_without_their_surroundings() -> None:
    """Foreign photos score less than these, so that at most one in twenty is said to be in it."""
    samples = own_samples(noise=0.3)
    model = fit_place_model(samples, [], PATHS, SCORES).model
    assert model.elsewhere is not None
    away = [s for s in samples if s.left_out == "level 1"]
    own = [s for s in samples if s.left_out is None]
    assert np.mean([bool(model.accepts(s.levels)) for s in away]) <= 0.05
    assert np.mean([bool(model.accepts(s.levels)) for s in own]) > 0.5
    at_home = [model.probabilities(model.extent.end_levels(s.levels), 0.05)[1] for s in own]
    assert np.mean([model.is_in_map(missing) is True for missing in at_home]) > 0.95


def test_what_is_less_similar_is_more_probably_elsewhere_whatever_the_own_photos_look_like() -> (
    None
):
    def samples(left_out: str | None, best: float, rival: float) -> list[PlaceSample]:
        scores = np.random.default_rng(0).normal([best, rival], 0.02, (20, 2)).tolist()
        return [PlaceSample(n, of_score(*s), [True], left_out) for n, s in enumerate(scores)]

    # The photo that is found without the place lies farther from its rivals.
    misleading = [*samples(None, 0.4, 0.5), *samples("level 0", 0.4, 0.3)]
    elsewhere = fit_place_model(misleading, [], PATHS, SCORES).model.elsewhere
    assert elsewhere is not None
    by_score = [elsewhere.probability(of_score(score, 0.5), 0.33) for score in (0, 0.2, 0.4, 0.6)]
    assert by_score == sorted(by_score, reverse=True)
    assert by_score[0] > 0.33


def test_an_own_photo_that_is_alone_at_its_place_is_no_example_of_a_query_in_the_map() -> None:
    alone = list(sampler(8, 1, 0.1).samples(range(8), 0.5))
    together = list(sampler(8, 2, 0.1).samples(range(16), 0.5))
    assert {s.is_alone for s in alone if s.left_out is None} == {True}
    assert {s.is_alone for s in together if s.left_out is None} == {False}
    assert missing_place_table(alone).weights.sum() == 0, "the prior is left as it is"
    table = missing_place_table([*alone, *together])
    assert (table.target == 0).sum() == 16


def held_out(probabilities: list[float], right: list[bool | None]) -> HeldOutEstimate:
    """The last level, that of the whole map, is added."""
    return HeldOutEstimate([*probabilities, 1.0], 0.0, [*right, True], None, 1.0)


def test_shared_neighbours_are_those_that_the_query_and_its_best_photo_find_first() -> None:
    ranked = [RankedPhoto(0.9 - n / 100, label("a"), n) for n in range(20)]
    others = [RankedPhoto(0.9 - n / 100, label("a"), 100 + n) for n in range(20)]
    assert shared_neighbours(ranked, ranked[1:]) == [1.0, 1.0, 1.0]
    assert shared_neighbours(ranked, others) == [1 / 5, 1 / 10, 1 / 20]  # the best photo itself
    assert shared_neighbours(ranked, ranked[:0:-1]) == [1 / 5, 1 / 10, 1.0]
    unknown = ranking((0.9, label("a")), (0.8, label("b")))
    assert shared_neighbours(unknown, unknown) == [0.0, 0.0, 0.0]


def test_a_ranking_like_that_of_its_best_photo_is_more_probable() -> None:
    """As for the samples of a map, in which shared neighbours tell right from wrong."""
    position = FEATURES.index("shared_neighbours_10")
    samples = own_samples()
    for sample in samples:
        assert len(sample.levels[0].features) == len(FEATURES)
        assert 0 < sample.levels[0].features[position] <= 1
    own = [s for s in samples if s.left_out is None]
    alike = [s.levels[0].features[position] for s in own if s.is_right[0]]
    unlike = [s.levels[0].features[position] for s in own if not s.is_right[0]]
    assert np.mean(alike) > np.mean(unlike)


def test_a_place_model_of_other_levels_is_not_used() -> None:
    model = PlaceModel(source="own_photos", scheme=PATHS)
    assert model.for_scheme(PATHS) is model
    assert model.for_scheme(PLAIN).source == "prior"


# --- fits ------------------------------------------------------------------------------------


def sampler(places: int, per_place: int, noise: float) -> OwnPhotoSampler:
    return town(places, per_place, noise)[0]


def town(
    places: int, per_place: int, noise: float, seed: int = 0, kinds: int | None = None
) -> tuple[OwnPhotoSampler, MapScores, list[tuple[list[RankedPhoto], PhotoLocation]]]:
    """A map of places on floors, whose photos are points around a centre for each place.

    Places of one of the `kinds`, if any, look alike.

    Returns:
        The map; what is known of its scores; and queries, two of each place and two of each of as
        many places elsewhere, at least 80 of both kinds, with the ranking of the map.
    """
    rng = np.random.default_rng(seed)
    centres = rng.normal(size=(places, 16))
    if kinds is not None:
        centres = centres[np.arange(places) % kinds] + 0.3 * centres

    def photos(around: FloatArray, each: int) -> FloatArray:
        points = np.repeat(around, each, 0)
        points += noise * rng.normal(size=points.shape)
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        return points

    rows = photos(centres, per_place)
    scores = rows @ rows.T
    names = [f"house/{n % 5}/{n}" for n in range(places)]
    locations = [label(name) for name in names for _ in range(per_place)]

    def rank(photo: int) -> IndexRanking:
        order = np.argsort(-scores[photo], kind="stable")
        order = order[order != photo]
        return order, scores[photo][order]

    own = OwnPhotoSampler(locations, [None] * len(locations), PATHS, 25.0, rank)
    background = Background.of(scores[np.triu_indices(len(rows), 1)].tolist())
    extent = MapExtent.of(locations, PATHS)
    known = MapScores(own.spread(range(len(rows))), background, extent)
    each = max(2, 80 // places)
    strangers = photos(rng.normal(size=(places, 16)), each)
    truths = [label(name) for name in [*names, *["barn"] * places] for _ in range(each)]
    queries = []
    for row, truth in zip([*photos(centres, each), *strangers], truths, strict=True):
        found = rows @ row
        order = np.argsort(-found, kind="stable")[:50].tolist()
        ranked = [RankedPhoto(float(found[n]), locations[n], n) for n in order]
        queries.append((ranked, truth))
    return own, known, queries


@functools.cache
def own_samples(noise: float = 1.0) -> list[PlaceSample]:
    own = sampler(40, 5, noise)
    photos = range(200)
    return list(own.samples(photos, own.spread(photos)))


def test_held_out_photos_have_the_observed_probabilities_and_few_impostors_get_an_answer() -> None:
    evaluation = evaluate_places(own_samples(), [], PATHS, SCORES)
    assert evaluation.figures is not None
    assert evaluation.model.source == "own_photos"
    for level in evaluation.figures["levels"]:
        stated = np.mean([each["stated"] for each in level["reliability"]])
        assert stated < level["accuracy"] + 0.05, "a third of the queries is assumed elsewhere"
        assert level["samples"] == 200
    shares = []
    for answers in evaluation.figures["answers"]:
        shares.append(answers["answered"]["mean"])
        if shares[-1] > 0.1:
            assert answers["precision"]["mean"] >= answers["certainty"] - 0.05
        assert answers["impostors_at_finest_level"] <= 1 - answers["certainty"] + 0.02
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.2


def test_model_knows_how_often_a_place_that_it_lacks_is_taken_for_one_that_looks_alike() -> None:
    def mistaken(kinds: int | None) -> list[float]:
        own, scores, _ = town(40, 5, 0.15, kinds=kinds)
        samples = [*own.samples(range(200), own.spread(range(200)))]
        model = fit_place_model(samples, [], PATHS, scores).model
        return [model.mistaken_share(certainty) for certainty in (0.5, 0.8, 0.95)]

    alike, different = mistaken(20), mistaken(None)
    assert alike[0] > 2 * different[0] > 0
    assert different == sorted(different, reverse=True)
    assert PlaceModel().mistaken_share(0.8) == 0.0


@pytest.mark.parametrize(
    ("places", "per_place", "noise"), [(40, 5, 0.6), (20, 3, 0.6), (4, 5, 0.3), (1, 60, 1.0)]
)
def test_probabilities_hold_in_maps_of_any_size_if_so_many_queries_are_from_elsewhere(
    places: int, per_place: int, noise: float
) -> None:
    own, known, queries = town(places, per_place, noise)
    samples = list(own.samples(range(places * per_place), known.spread))
    model = fit_place_model(samples, [], PATHS, known).model
    for elsewhere in (0.05, ELSEWHERE_SHARE):
        check_probabilities(model, own, queries, places * per_place, elsewhere)


def check_probabilities(
    model: PlaceModel,
    own: OwnPhotoSampler,
    queries: list[tuple[list[RankedPhoto], PhotoLocation]],
    photos: int,
    elsewhere: float,
) -> None:
    highest = (photos + 1) / (photos + 2)
    strangers = []
    stated: tuple[list[float], list[float]] = ([], [])
    right: tuple[list[bool], list[bool]] = ([], [])
    for ranked, truth in queries:
        around = own.neighbours(int(str(ranked[0].photo)))
        told = model.estimate(ranked, around, PATHS, 0.95, 25.0, elsewhere=elsewhere)
        assert told is not None
        assert list(told.probabilities) == sorted(told.probabilities)
        assert told.probabilities[-1] <= highest + 1e-12
        assert told.not_in_map == pytest.approx(1 - told.probabilities[-1])
        is_stranger = truth.place == "barn"
        strangers += [told.answer is not None] if is_stranger else []
        count = round(100 * (elsewhere if is_stranger else 1 - elsewhere))
        for level, is_right in ((0, told.levels[0].is_right(truth) is True), (-1, not is_stranger)):
            stated[level].extend([told.probabilities[level]] * count)
            right[level].extend([is_right] * count)
    for said, seen in zip(stated, right, strict=True):
        assert np.mean(said) <= np.mean(seen) + 0.1 + 1 / photos, "never surer"
        if photos == 200:
            assert expected_calibration_error(said, seen) < 0.1
    if elsewhere == ELSEWHERE_SHARE:
        assert np.mean(strangers) <= 0.05


def test_a_map_of_few_photos_keeps_the_prior_and_a_small_one_stays_near_it() -> None:
    few = [s for s in own_samples() if s.photo < 19]
    assert fit_place_model(few, [], PATHS, SCORES).model == PlaceModel()
    small = fit_place_model([s for s in own_samples() if s.photo < 30], [], PATHS, SCORES).model
    large = fit_place_model(own_samples(), [], PATHS, SCORES).model
    assert (small.own_photos, large.own_photos) == (30, 200)

    def change(model: PlaceModel) -> float:
        return float(np.linalg.norm(np.array(model.levels[0]) - shipped_prior().level))

    assert change(small) < change(large)
    sources = (small.source, small.calibration_source, large.calibration_source)
    assert sources == ("own_photos", "prior", "prior")


def test_the_calibration_source_is_the_prior_below_two_thousand_own_photos() -> None:
    for own_photos, expected in ((1999, "prior"), (2000, "own_photos")):
        model = PlaceModel(source="own_photos", own_photos=own_photos)
        assert model.calibration_source == expected
        assert model.is_fitted, "a small map answers with its own thresholds"
    labelled = PlaceModel(source="labelled_queries", own_photos=30, labelled_queries=40)
    assert labelled.calibration_source == "labelled_queries"
    assert PlaceModel().calibration_source == "prior"


def test_labelled_queries_refine_the_place_model() -> None:
    """Half of the queries that look certain are wrong: the own photos did not say so."""
    samples = own_samples(noise=0.3)
    own = [s for s in samples if s.left_out is None][: MIN_LABELLED_QUERIES + 20]
    wrong = [PlaceSample(n, s.levels, [bool(n % 2)] * len(s.levels)) for n, s in enumerate(own)]
    fitted = fit_place_model(samples, wrong, PATHS, SCORES)
    assert fitted.model.source == "labelled_queries"
    before = fit_place_model(samples, [], PATHS, SCORES).model
    sure = [before.probabilities(s.levels)[0][0] for s in own]
    refined = [fitted.model.probabilities(s.levels)[0][0] for s in own]
    assert np.mean(sure) > 0.9
    assert abs(np.mean(refined) - 0.5) < abs(np.mean(sure) - 0.5)
    too_few = fit_place_model(samples, wrong[: MIN_LABELLED_QUERIES - 1], PATHS, SCORES)
    assert too_few.model == before


# --- matches of local features -----------------------------------------------------------------


def true_support(photo: int, others: Sequence[Any]) -> list[float]:
    """Many matches between photos of one place, and few between others."""
    return [80.0 if photo // 5 == other // 5 else 4.0 for other in others]


def answered(evaluation: PlaceEvaluation) -> float:
    assert evaluation.figures is not None
    (at_95,) = (a for a in evaluation.figures["answers"] if a["certainty"] == 0.95)
    share: float = at_95["answered_at_finest_level"]["mean"]
    return share


def test_matches_answer_what_similar_descriptors_leave_open() -> None:
    own = sampler(places=40, per_place=5, noise=1.2)
    photos = range(200)
    spread = own.spread(photos)
    plain = evaluate_places(list(own.samples(photos, spread)), [], PATHS, SCORES)
    samples = list(own.samples(photos, spread, true_support))
    assert len(samples[0].levels[0].features) == len(FEATURES) + len(MATCH_FEATURES)
    matched = evaluate_places(samples, [], PATHS, SCORES)
    assert answered(matched) > answered(plain) + 0.3
    assert not answers_less(plain, matched)
    assert matched.figures is not None
    assert matched.figures["answers"][2]["precision"]["mean"] >= 0.95


def test_a_map_whose_photos_do_not_match_each_other_is_answered_less_with_matches() -> None:
    own = sampler(places=40, per_place=5, noise=0.2)
    known = replace(SCORES, extractor="efficientnet-lite0-vlad128")
    plain, matched = (
        evaluate_places(list(own.samples(range(200), 0.5, match)), [], PATHS, known)
        for match in (None, lambda _, others: [4.0] * len(others))
    )
    assert answers_less(plain, matched)


def test_samples_whose_first_photos_were_not_all_compared_have_no_matches() -> None:
    own = sampler(places=5, per_place=5, noise=1.0)

    def without_the_last(photo: int, others: Sequence[Any]) -> list[float | None]:
        return [*true_support(photo, others)[:-1], None]

    assert list(own.samples(range(25), 0.5, without_the_last)) == []


def test_matches_choose_the_place_but_only_if_the_map_is_fitted_for_them() -> None:
    first, other = label("house/1/hall"), label("house/2/lobby")
    ranking = [RankedPhoto(0.9 - n / 100, first if n % 2 == 0 else other, n) for n in range(10)]
    compared = [
        replace(r, support=90.0 if r.location == other else 2.0, score=r.score) for r in ranking
    ]
    plain = PlaceModel(source="own_photos", scheme=PATHS, spread=0.1)
    matching = plain.model_copy(update={"with_matches": plain})
    partly = [replace(compared[0], support=None), *compared[1:]]
    for model, ranked, expected in (
        (matching, compared, other),
        (plain, compared, first),
        (matching, partly, first),
    ):
        estimate = model.estimate(ranked, [], PATHS, 0.95, 25.0)
        assert estimate is not None
        assert (estimate.levels[0].place, estimate.location) == (expected.place, expected)


def test_levels_learn_nothing_from_impostors_which_look_as_weak_as_a_query_at_night() -> None:
    scores = replace(SCORES, extractor="efficientnet-lite0-vlad128")
    own = [sample for sample in own_samples() if sample.left_out is None]
    levels = [fit_place_model(s, [], PATHS, scores).model.levels for s in (own, own_samples())]
    assert levels[0] == levels[1]


@pytest.mark.parametrize(("error", "allowed"), [(0.05, 1), (0.1, 3)])
def test_a_guarantee_counts_one_more_labelled_query_as_wrong(error: float, allowed: int) -> None:
    wrong_until = [0.9 - n / 100 for n in range(40)]
    threshold = PlaceModel(wrong_until=tuple(wrong_until)).threshold(0.95, error)
    assert sum(each >= threshold for each in wrong_until) == allowed
    assert (allowed + 1) / 41 <= error < (allowed + 2) / 41


def test_a_guarantee_without_enough_labelled_queries_says_how_many_it_takes() -> None:
    with pytest.raises(Unprocessable, match="takes 99 labelled queries") as refused:
        PlaceModel(wrong_until=(0.0,) * 98).threshold(0.95, 0.01)
    assert refused.value.code == "too_few_labelled_queries"
    assert PlaceModel(wrong_until=(0.0,) * 99).threshold(0.95, 0.01) < 1e-9


def test_queries_are_new_to_a_map_if_they_are_less_similar_than_those_of_its_calibration() -> None:
    model = PlaceModel(own_photos=100, best_scores=tuple(np.linspace(0.1, 0.5, 101).tolist()))
    rng = np.random.default_rng(0)
    assert not model.is_new(rng.uniform(0.1, 0.5, 100).tolist())
    assert not model.is_new(rng.uniform(0.3, 0.5, 100).tolist()), "more similar ones are not new"
    assert model.is_new(rng.uniform(0.1, 0.2, 100).tolist())
    assert not model.is_new([0.1] * 29), "too few to tell"
