"""Learning a map's word weights, and trying them on photos that have not taught them.

The map is dealt out in two halves, place by place (`shared.word_weights.training_pairs`).
Photos of one half
are asked with what the other half has taught, in the whole map through the search tier that answers
users. Each is left out with whatever lies within 5 m of it: its own burst would come first with and
without weights, and hide what they do. Only where more photos find their place first than without
weights, and more than by chance, the weights are kept: those that both halves teach together.

What the rows of a map's photos teach of its words, read a lesson at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.steward.evaluation_search import MAX_READ_ATTEMPTS, GeotaggedPhoto, map_damaged_error
from services.steward.map_evaluation import MapEvaluation, RecallCounter
from shared.catalog.chunks import find_descriptor_rows
from shared.catalog.generations import Generation
from shared.catalog.session import Catalog
from shared.errors import NotFound
from shared.evaluation.place_evidence import is_same_place
from shared.storage import ObjectStore
from shared.storage.chunks import Rows, read_rows, rows_are_valid
from shared.word_weights.record import HeldOut, Outcome, WordWeights
from shared.word_weights.training_pairs import (
    MIN_PAIRS,
    NEAREST_M,
    PairBatch,
    PairSource,
    PairSplit,
    sample_pairs,
)
from shared.word_weights.weights import (
    PairStatistics,
    empty_pair_statistics,
    is_significant_improvement,
    sign_test_p_value,
)

ROW_BATCH_BYTES = 64_000_000  # of rows in memory: 160 photos at 98,304 dimensions
MIN_BATCH_ROWS = 8  # however long they are: the far pairs come from the same photos


def photos_per_lesson(dimension: int) -> int:
    """How many photos a lesson may have."""
    return max(MIN_BATCH_ROWS, ROW_BATCH_BYTES // (dimension * np.dtype(np.float32).itemsize))


def accumulate_pair_statistics(
    catalog: Catalog,
    store: ObjectStore,
    generation_id: UUID,
    photo_ids: Sequence[UUID],
    lessons: Sequence[PairBatch],
    words: int,
    on_lesson: Callable[[], None],
) -> PairStatistics:
    """What the lessons about `photo_ids` come to; pairs of photos deleted since are left out.

    Holds the rows of one lesson at a time. Conflict (`map_damaged`) for rows that can't be read.
    """
    taught = empty_pair_statistics(words)
    for lesson in lessons:
        on_lesson()
        rows, there = _read_photo_rows(
            catalog, store, generation_id, [photo_ids[i] for i in lesson.photos]
        )
        near, far = (pairs[there[pairs].all(axis=1)] for pairs in (lesson.near, lesson.far))
        taught += PairStatistics.from_rows(rows, near, far, words)
    return taught


def _read_photo_rows(
    catalog: Catalog, store: ObjectStore, generation_id: UUID, photo_ids: Sequence[UUID]
) -> tuple[Rows, NDArray[np.bool_]]:
    """(n, dimension) rows in the photos' order, and which of them there are."""
    place_of = {photo_id: place for place, photo_id in enumerate(photo_ids)}
    for attempt in range(1, MAX_READ_ATTEMPTS + 1):
        with catalog.read() as session:
            located = find_descriptor_rows(session, generation_id, photo_ids)
        found: Rows | None = None
        there = np.zeros(len(photo_ids), dtype=bool)
        try:
            for object_key, rows in located.items():
                read = _read_rows_checked(store, object_key, [row for row, _ in rows])
                if found is None:
                    found = np.zeros((len(photo_ids), read.shape[1]), dtype=np.float32)
                places = [place_of[photo_id] for _, photo_id in rows]
                found[places], there[places] = read, True
        except NotFound as error:  # the chunk was merged into another between the two reads
            if attempt == MAX_READ_ATTEMPTS:
                raise map_damaged_error(sorted(located)) from error
            continue
        return found if found is not None else np.zeros((len(photo_ids), 0), np.float32), there
    raise AssertionError("the last try returns or raises")


def _read_rows_checked(store: ObjectStore, object_key: str, rows: Sequence[int]) -> Rows:
    try:
        read = read_rows(store, object_key, rows)
    except (IndexError, ValueError) as error:
        raise map_damaged_error([object_key]) from error
    if not rows_are_valid(read).all():
        raise map_damaged_error([object_key])
    return read


WEIGHT_DECIMALS = 6  # of a weight, as it is stored
TRIAL_RANKS = 10  # looked at for R@10
MAX_BURST_PHOTOS = (
    200  # photos that are left out with one: more are a fixed camera's, and not asked with
)


class WordWeightsFit:
    """Learns the weights of one generation with `words` words in its vocabulary."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        generation: Generation,
        words: int,
        measure: MapEvaluation,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._generation = generation
        self._words = words
        self._evaluation = measure

    def fit(self, sample: Sequence[GeotaggedPhoto], seed: int, searchable: int) -> WordWeights:
        """What there is to keep, whatever came of it. `sample` are the photos to try weights on.

        Raises what `MapEvaluation` and `teach` raise.
        """
        photos = self._evaluation.database.photos
        chosen = sample_pairs(
            [photo.spot for photo in photos], seed, photos_per_lesson(self._generation.dimension)
        )
        halves = self._fit_halves(chosen)
        record = WordWeights(
            outcome=Outcome.NOT_ENOUGH_PAIRS,
            reason=_not_enough_pairs_reason(chosen.by, halves),
            taught_by=chosen.by,
            near_pairs=sum(half.near.pairs for half in halves),
            far_pairs=sum(half.far.pairs for half in halves),
            seed=seed,
            searchable=searchable,
        )
        if min(min(half.near.pairs, half.far.pairs) for half in halves) < MIN_PAIRS:
            return record
        together = _rounded_weights(halves[0] + halves[1])
        of_other_half = (_rounded_weights(halves[1]), _rounded_weights(halves[0]))
        half_of = {photo.photo_id: half for photo, half in zip(photos, chosen.halves, strict=True)}
        tried = [(query, of_other_half[half_of[query.photo_id]]) for query in sample]
        held_out = self._cross_validate(tried, chosen.by)
        kept = is_significant_improvement(held_out.better, held_out.worse)
        record = record.model_copy(
            update={
                "outcome": Outcome.KEPT if kept else Outcome.NOT_KEPT,
                "reason": _held_out_reason(held_out),
                "weights": together,
                "held_out": held_out,
            }
        )
        if kept:
            measured = self._evaluation.evaluate(sample, together)
            record = record.model_copy(update={"calibration": measured.calibration})
        return record

    def _fit_halves(self, chosen: PairSplit) -> tuple[PairStatistics, PairStatistics]:
        ids = [photo.photo_id for photo in self._evaluation.database.photos]

        def half(lessons: int) -> PairStatistics:
            return accumulate_pair_statistics(
                self._catalog,
                self._store,
                self._generation.id,
                ids,
                chosen.batches[lessons],
                self._words,
                self._evaluation.on_query,
            )

        return half(0), half(1)

    def _cross_validate(
        self, sample: Sequence[tuple[GeotaggedPhoto, tuple[float, ...]]], by: PairSource
    ) -> HeldOut:
        """Each photo that is not alone at its place, asked without weights and with these."""
        without, weighted, better, worse = RecallCounter(), RecallCounter(), 0, 0
        for query, weights in sample:
            self._evaluation.on_query()
            burst = self._photos_to_exclude(query, by)
            if burst is None:
                continue
            plain, found = (
                self._correct_ranks(query, (), burst),
                self._correct_ranks(query, weights, burst),
            )
            if plain is None or found is None:
                continue
            without.add(plain)
            weighted.add(found)
            better += any(found[:1]) and not any(plain[:1])
            worse += any(plain[:1]) and not any(found[:1])
        return HeldOut(
            without=without.figures(),
            weighted=weighted.figures(),
            better=better,
            worse=worse,
            chance=sign_test_p_value(better, worse),
        )

    def _photos_to_exclude(self, query: GeotaggedPhoto, by: PairSource) -> tuple[UUID, ...] | None:
        """What is left out with the photo; None where nothing of its place would be left."""
        database, radius_m = self._evaluation.database, self._evaluation.radius_m
        if by == PairSource.PLACES:
            return (
                () if database.count_at_place(query.spot, radius_m) > 1 else None
            )  # itself is one
        burst = database.find_within(query.spot, NEAREST_M)  # itself among them
        alone = len(database.find_within(query.spot, radius_m)) == len(burst)
        return None if alone or len(burst) > MAX_BURST_PHOTOS else tuple(burst)

    def _correct_ranks(
        self, query: GeotaggedPhoto, weights: tuple[float, ...], without: tuple[UUID, ...]
    ) -> list[bool] | None:
        """Which photos of the ranking show the query's place; None for a deleted query."""
        ranking = self._evaluation.search.rank_similar(query, TRIAL_RANKS, weights, without)
        if ranking is None:
            return None
        return [is_same_place(query.spot, spot, self._evaluation.radius_m) for _, spot in ranking]


def _rounded_weights(taught: PairStatistics) -> tuple[float, ...]:
    return tuple(round(weight, WEIGHT_DECIMALS) for weight in taught.weights().tolist())


def _not_enough_pairs_reason(by: PairSource, halves: tuple[PairStatistics, PairStatistics]) -> str:
    near, far = ([half.near.pairs for half in halves], [half.far.pairs for half in halves])
    what = "5 to 25 m apart" if by == PairSource.COORDINATES else "under one label"
    return (
        f"By {by} the two halves of the map have {near[0]} and {near[1]} pairs of photos of one "
        f"place ({what}) and {far[0]} and {far[1]} of two places; {MIN_PAIRS} of either kind are "
        "needed in each half."
    )


def _held_out_reason(held_out: HeldOut) -> str:
    return (
        f"Of {held_out.without['queries']} photos, each asked with what the other half of the map "
        f"has taught, {held_out.better} find their place first with weights alone and "
        f"{held_out.worse} without them alone (by chance: p = {held_out.chance:.2g})."
    )
