"""Word weights: the formula against plain loops, which pairs teach, and what counts as a rise."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from shared.evaluation.places.evidence import PhotoLocation, distance_between_m
from shared.word_weights.training_pairs import (
    MAX_PAIRS,
    MIN_PAIRS,
    PairBatch,
    PairSource,
    PairSplit,
    sample_pairs,
)
from shared.word_weights.weights import (
    PairStatistics,
    ProductMoments,
    apply_word_weights,
    empty_pair_statistics,
    is_significant_improvement,
    sign_test_p_value,
    word_products,
)

pytestmark = pytest.mark.numerics

WORDS, WIDTH = 4, 3
DEGREES_PER_M = math.degrees(1 / 6_371_008.8)
Rows = NDArray[np.float32]


def unit_rows(seed: int, count: int) -> Rows:
    rows = np.random.default_rng(seed).standard_normal((count, WORDS * WIDTH))
    found: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return found


def north(metres: float, place: str | None = None) -> PhotoLocation:
    return PhotoLocation(metres * DEGREES_PER_M, 7.0, place)


# --- the formula -----------------------------------------------------------------------------


def test_products_of_a_pairs_words_add_up_to_its_cosine() -> None:
    rows = unit_rows(1, 5)
    pairs = np.array(list(combinations(range(5), 2)))
    products = word_products(rows, pairs, WORDS)
    cosines = [float(rows[a].astype(np.float64) @ rows[b]) for a, b in pairs.tolist()]
    assert products.sum(axis=1) == pytest.approx(cosines, abs=1e-7)
    assert products[0, 2] == pytest.approx(float(rows[0, 6:9] @ rows[1, 6:9]), abs=1e-7)


def test_weights_are_the_gap_of_the_means_over_the_deviation_of_far_pairs() -> None:
    near = np.array([[0.3, 0.1, 0.0], [0.5, 0.1, 0.0]])
    far = np.array([[0.1, 0.2, 0.0], [0.3, 0.6, 0.0], [0.2, 0.1, 0.0]])
    expected = (0.4 - 0.2) / np.std([0.1, 0.3, 0.2])
    weights = PairStatistics(
        ProductMoments.from_products(near), ProductMoments.from_products(far)
    ).weights()
    # The second word is more alike between two places; the third occurs in no pair.
    assert weights == pytest.approx([expected, 0.0, 0.0])


def test_what_two_halves_teach_adds_up_and_without_pairs_nothing_can_be_learnt() -> None:
    rng = np.random.default_rng(3)
    near, far = rng.random((10, WORDS)), rng.random((12, WORDS))
    whole = PairStatistics(ProductMoments.from_products(near), ProductMoments.from_products(far))
    parts = empty_pair_statistics(WORDS)
    for part in (slice(0, 4), slice(4, None)):
        parts += PairStatistics(
            ProductMoments.from_products(near[part]), ProductMoments.from_products(far[part])
        )
    assert parts.weights() == pytest.approx(whole.weights())
    with pytest.raises(ValueError, match="0 near and 0 far"):
        empty_pair_statistics(WORDS).weights()


def test_weighted_query_is_its_words_multiplied_and_of_length_one_unless_nothing_is_left() -> None:
    query = unit_rows(2, 1)[0]
    weighted = apply_word_weights(query, [2.0, 0.0, 1.0, 0.5])
    assert weighted is not None
    expected = query.astype(np.float64) * np.repeat([2.0, 0.0, 1.0, 0.5], WIDTH)
    assert weighted == pytest.approx(expected / np.linalg.norm(expected))
    assert apply_word_weights(query, [1.0] * WORDS) == pytest.approx(
        query.astype(np.float64), abs=1e-6
    )
    assert apply_word_weights(query, [0.0] * WORDS) is None
    with pytest.raises(ValueError, match="5 weights don't fit 12"):
        apply_word_weights(query, [1.0] * 5)


# --- which pairs -----------------------------------------------------------------------------


def street(places: int, views: int = 4) -> list[PhotoLocation]:
    """Places 200 m apart; the views of each 6 m apart."""
    return [north(200 * place + 6 * view) for place in range(places) for view in range(views)]


def pairs_of(lesson: PairBatch, kind: str) -> list[tuple[int, int]]:
    pairs: NDArray[np.int64] = getattr(lesson, kind)
    return [(lesson.photos[one], lesson.photos[other]) for one, other in pairs.tolist()]


def all_pairs(chosen: PairSplit, half: int, kind: str) -> list[tuple[int, int]]:
    return [pair for lesson in chosen.batches[half] for pair in pairs_of(lesson, kind)]


def test_near_pairs_are_5_to_25_m_apart_far_ones_over_50_and_each_lies_in_one_half() -> None:
    spots = [*street(60), *(north(12_000 + 2 * n) for n in range(30))]  # a burst of 2 m steps
    chosen = sample_pairs(spots, seed=0, batch_photos=10_000)
    assert chosen.source == PairSource.COORDINATES
    assert chosen.is_enough
    for half in (0, 1):
        for kind, least, most in (("near", 5.0, 25.0), ("far", 50.0, math.inf)):
            pairs = all_pairs(chosen, half, kind)
            assert len(set(pairs)) == len(pairs) >= MIN_PAIRS
            for one, other in pairs:
                away = distance_between_m(spots[one], spots[other])
                assert away is not None
                assert least <= away <= most
                assert chosen.halves[one] == chosen.halves[other] == half


def test_photos_of_one_place_are_in_one_half_and_the_halves_are_alike_in_size() -> None:
    spots = street(61)
    halves = sample_pairs(spots, seed=5, batch_photos=100).halves
    for place in range(61):
        assert len(set(halves[4 * place : 4 * place + 4])) == 1
    assert abs(2 * sum(halves) - len(halves)) <= 4


def test_pairs_are_bounded_however_many_photos_there_are() -> None:
    spots = street(1500)
    chosen = sample_pairs(spots, seed=0, batch_photos=10_000)
    assert chosen.counts() == [(MAX_PAIRS, MAX_PAIRS)] * 2


def test_batches_have_at_most_the_photos_that_fit_into_memory() -> None:
    chosen = sample_pairs(street(60), seed=0, batch_photos=16)
    lessons = [*chosen.batches[0], *chosen.batches[1]]
    assert all(len(set(lesson.photos)) == len(lesson.photos) <= 16 for lesson in lessons)
    assert all(len(lesson.far) <= len(lesson.near) for lesson in lessons)
    assert chosen.counts() != sample_pairs(street(60), seed=0, batch_photos=2).counts()


def test_same_seed_gives_the_same_pairs_and_another_seed_others() -> None:
    one, again, other = (sample_pairs(street(60), seed, 100) for seed in (1, 1, 2))
    assert all_pairs(one, 0, "near") == all_pairs(again, 0, "near")
    assert all_pairs(one, 0, "far") == all_pairs(again, 0, "far")
    assert one.halves == again.halves != other.halves


def test_pairs_are_sampled_by_place_labels_where_rooms_share_coordinates() -> None:
    """Also those that bear the coordinates of their building, all the same."""
    spots = [PhotoLocation(45.0, 7.0, f"room {n // 6}") for n in range(240)]
    chosen = sample_pairs(spots, seed=0, batch_photos=100)
    assert (chosen.source, chosen.is_enough) == (PairSource.PLACES, True)
    for half in (0, 1):
        assert all(spots[a].place == spots[b].place for a, b in all_pairs(chosen, half, "near"))
        assert all(spots[a].place != spots[b].place for a, b in all_pairs(chosen, half, "far"))


@pytest.mark.parametrize(
    "spots",
    [
        [],
        [PhotoLocation(None, None, "hall")],
        [north(200.0 * n) for n in range(300)],  # each alone
        [north(6.0 * (n % 3)) for n in range(300)],  # one place
        street(10),
    ],
)
def test_too_few_pairs_are_counted_and_not_enough(spots: list[PhotoLocation]) -> None:
    chosen = sample_pairs(spots, seed=0, batch_photos=100)
    assert not chosen.is_enough
    assert min(min(counts) for counts in chosen.counts()) < MIN_PAIRS


# --- what counts as a rise -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("better", "worse", "chance"),
    [(0, 0, 1.0), (1, 0, 0.5), (3, 1, 5 / 16), (5, 0, 1 / 32), (0, 5, 1.0)],
)
def test_chance_is_that_of_so_many_heads_or_more(better: int, worse: int, chance: float) -> None:
    assert sign_test_p_value(better, worse) == pytest.approx(chance)


def test_a_rise_is_more_than_chance() -> None:
    assert is_significant_improvement(5, 0)
    assert not is_significant_improvement(4, 0)
    assert not is_significant_improvement(60, 55)
    assert is_significant_improvement(700, 500)
