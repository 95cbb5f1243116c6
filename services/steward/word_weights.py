"""Fits a map's word weights and validates them on held-out photos.

The map is split into two halves by place (`shared.word_weights.training_pairs`). Photos of one half
are searched, in the whole map and through the search tier, with the weights fitted on the other
half. Each query is excluded from the results together with all photos within 5 m: its own burst
would rank first with and without weights, and hide their effect. The weights, fitted on both
halves, are kept only if significantly more photos find their place at rank 1 than without weights.

Descriptor rows are read in batches, to bound the memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.steward.evaluation_search import MAX_READ_ATTEMPTS, GeotaggedPhoto, map_damaged_error
from services.steward.map_evaluation import MapEvaluation, RecallCounter
from shared.catalog.chunks import find_descriptor_rows
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.errors import NotFound
from shared.evaluation.places.evidence import is_same_place
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

ROW_BATCH_BYTES = 64_000_000  # rows in memory: 160 photos at 98,304 dimensions
MIN_BATCH_ROWS = 8  # at any dimension: the far pairs come from the same photos


def _accumulate_pair_statistics(
    catalog: Catalog,
    store: ObjectStore,
    generation_id: UUID,
    photo_ids: Sequence[UUID],
    batches: Sequence[PairBatch],
    words: int,
    on_batch: Callable[[], None],
) -> PairStatistics:
    """Accumulate the statistics of photo pairs, reading the rows of one batch at a time.

    The batches index `photo_ids`. Pairs with a photo that was deleted since are left out.
    `on_batch` is called before each batch; an exception that it raises ends the loop.

    Raises:
        Conflict: `map_damaged`: rows can't be read.
    """
    statistics = empty_pair_statistics(words)
    for batch in batches:
        on_batch()
        rows, exists = _read_photo_rows(
            catalog, store, generation_id, [photo_ids[i] for i in batch.photos]
        )
        near, far = (pairs[exists[pairs].all(axis=1)] for pairs in (batch.near, batch.far))
        statistics += PairStatistics.from_rows(rows, near, far, words)
    return statistics


def _read_photo_rows(
    catalog: Catalog, store: ObjectStore, generation_id: UUID, photo_ids: Sequence[UUID]
) -> tuple[Rows, NDArray[np.bool_]]:
    """Return (n, dimension) rows in the photos' order, and an (n,) mask of the existing ones."""
    index_of = {photo_id: index for index, photo_id in enumerate(photo_ids)}
    for attempt in range(1, MAX_READ_ATTEMPTS + 1):
        with catalog.read() as session:
            located = find_descriptor_rows(session, generation_id, photo_ids)
        matrix: Rows | None = None
        exists = np.zeros(len(photo_ids), dtype=bool)
        try:
            for object_key, rows in located.items():
                chunk_rows = _read_rows_checked(store, object_key, [row for row, _ in rows])
                if matrix is None:
                    matrix = np.zeros((len(photo_ids), chunk_rows.shape[1]), dtype=np.float32)
                indices = [index_of[photo_id] for _, photo_id in rows]
                matrix[indices], exists[indices] = chunk_rows, True
        except NotFound as error:  # the chunk was merged into another one between the two reads
            if attempt == MAX_READ_ATTEMPTS:
                raise map_damaged_error(sorted(located)) from error
            continue
        return matrix if matrix is not None else np.zeros((len(photo_ids), 0), np.float32), exists
    raise AssertionError("the last attempt returns or raises")


def _read_rows_checked(store: ObjectStore, object_key: str, row_numbers: Sequence[int]) -> Rows:
    try:
        rows = read_rows(store, object_key, row_numbers)
    except (IndexError, ValueError) as error:
        raise map_damaged_error([object_key]) from error
    if not rows_are_valid(rows).all():
        raise map_damaged_error([object_key])
    return rows


WEIGHT_DECIMALS = 6  # precision of stored weights
VALIDATION_RANKS = 10  # results per query, for R@10
# Largest number of photos excluded with a query. A larger burst is a fixed camera's, which is not
# used as a query.
MAX_BURST_PHOTOS = 200


@dataclass(frozen=True, slots=True)
class WordWeightsFit:
    """Fits and validates the word weights of one generation, whose vocabulary has `words` words.

    The evaluation of the generation gives its photos and its search client.
    """

    catalog: Catalog
    store: ObjectStore
    generation: Generation
    words: int
    evaluation: MapEvaluation

    def fit(self, sample: Sequence[GeotaggedPhoto], seed: int, searchable: int) -> WordWeights:
        """Fit the weights, and validate them with the photos of the sample.

        `searchable` is the number of searchable photos, stored with the record.

        Returns:
            The record to store, also where the weights were not kept.

        Raises:
            Conflict, Unavailable: As `EvaluationSearch.rank_similar` and
                `_accumulate_pair_statistics`.
        """
        photos = self.evaluation.database.photos
        row_bytes = self.generation.dimension * np.dtype(np.float32).itemsize
        batch_photos = max(MIN_BATCH_ROWS, ROW_BATCH_BYTES // row_bytes)
        split = sample_pairs([photo.spot for photo in photos], seed, batch_photos)
        halves = self._fit_halves(split)
        record = WordWeights(
            outcome=Outcome.NOT_ENOUGH_PAIRS,
            reason=_not_enough_pairs_reason(split.source, halves),
            taught_by=split.source,
            near_pairs=sum(half.near.pairs for half in halves),
            far_pairs=sum(half.far.pairs for half in halves),
            seed=seed,
            searchable=searchable,
        )
        if min(min(half.near.pairs, half.far.pairs) for half in halves) < MIN_PAIRS:
            return record
        weights = _rounded_weights(halves[0] + halves[1])
        weights_of_other_half = (_rounded_weights(halves[1]), _rounded_weights(halves[0]))
        half_of = {photo.photo_id: half for photo, half in zip(photos, split.halves, strict=True)}
        queries = [(query, weights_of_other_half[half_of[query.photo_id]]) for query in sample]
        held_out = self._cross_validate(queries, split.source)
        is_better = is_significant_improvement(held_out.better, held_out.worse)
        record = record.model_copy(
            update={
                "outcome": Outcome.KEPT if is_better else Outcome.NOT_KEPT,
                "reason": _held_out_reason(held_out),
                "weights": weights,
                "held_out": held_out,
            }
        )
        if is_better:
            result = self.evaluation.evaluate(sample, weights)
            record = record.model_copy(update={"calibration": result.model})
        return record

    def _fit_halves(self, split: PairSplit) -> tuple[PairStatistics, PairStatistics]:
        ids = [photo.photo_id for photo in self.evaluation.database.photos]

        def fit_half(half: int) -> PairStatistics:
            return _accumulate_pair_statistics(
                self.catalog,
                self.store,
                self.generation.id,
                ids,
                split.batches[half],
                self.words,
                self.evaluation.on_query,
            )

        return fit_half(0), fit_half(1)

    def _cross_validate(
        self, queries: Sequence[tuple[GeotaggedPhoto, tuple[float, ...]]], by: PairSource
    ) -> HeldOut:
        """Search with each photo that is not alone at its place, without and with its weights."""
        without, weighted, better, worse = RecallCounter(), RecallCounter(), 0, 0
        for query, weights in queries:
            self.evaluation.on_query()
            burst = self._photos_to_exclude(query, by)
            if burst is None:
                continue
            correct_without = self._correct_ranks(query, (), burst)
            correct_weighted = self._correct_ranks(query, weights, burst)
            if correct_without is None or correct_weighted is None:
                continue
            without.add(correct_without)
            weighted.add(correct_weighted)
            better += any(correct_weighted[:1]) and not any(correct_without[:1])
            worse += any(correct_without[:1]) and not any(correct_weighted[:1])
        return HeldOut(
            without=without.figures(),
            weighted=weighted.figures(),
            better=better,
            worse=worse,
            chance=sign_test_p_value(better, worse),
        )

    def _photos_to_exclude(self, query: GeotaggedPhoto, by: PairSource) -> tuple[UUID, ...] | None:
        """Return the photos to exclude with the query; None if no photo of its place would remain
        or the burst is too large."""
        database, radius_m = self.evaluation.database, self.evaluation.radius_m
        if by == PairSource.PLACES:
            # They include the query itself.
            return () if len(database.find_at_place(query.spot, radius_m)) > 1 else None
        burst = database.find_within(query.spot, NEAREST_M)  # includes the query itself
        alone = len(database.find_within(query.spot, radius_m)) == len(burst)
        if alone or len(burst) > MAX_BURST_PHOTOS:
            return None
        return tuple(photo.photo_id for photo in burst)

    def _correct_ranks(
        self, query: GeotaggedPhoto, weights: tuple[float, ...], excluded: tuple[UUID, ...]
    ) -> list[bool] | None:
        """Return for each rank whether it shows the query's place; None for a deleted query."""
        ranking = self.evaluation.search.rank_similar(query, VALIDATION_RANKS, weights, excluded)
        if ranking is None:
            return None
        return [is_same_place(query.spot, spot, self.evaluation.radius_m) for _, spot in ranking]


def _rounded_weights(statistics: PairStatistics) -> tuple[float, ...]:
    return tuple(round(weight, WEIGHT_DECIMALS) for weight in statistics.weights().tolist())


def _not_enough_pairs_reason(by: PairSource, halves: tuple[PairStatistics, PairStatistics]) -> str:
    near, far = ([half.near.pairs for half in halves], [half.far.pairs for half in halves])
    criterion = "5 to 25 m apart" if by == PairSource.COORDINATES else "with the same label"
    return (
        f"By {by}, the two halves of the map have {near[0]} and {near[1]} pairs of photos of one "
        f"place ({criterion}) and {far[0]} and {far[1]} pairs of two places; each half needs "
        f"{MIN_PAIRS} pairs of each kind."
    )


def _held_out_reason(held_out: HeldOut) -> str:
    return (
        f"Of {held_out.without['queries']} photos, each searched with the weights fitted on the "
        f"other half of the map, {held_out.better} find their place at rank 1 only with weights "
        f"and {held_out.worse} only without (sign test: p = {held_out.chance:.2g})."
    )
