"""Learning a map's word weights, and trying them on photos that have not taught them.

The map is dealt out in two halves, place by place (`shared.word_weights.pairs`). Photos of one half
are asked with what the other half has taught, in the whole map through the search tier that answers
users. Each is left out with whatever lies within 5 m of it: its own burst would come first with and
without weights, and hide what they do. Only where more photos find their place first than without
weights, and more than by chance, the weights are kept: those that both halves teach together.
"""

from __future__ import annotations

from collections.abc import Sequence
from uuid import UUID

from services.steward.labelled import Recall
from services.steward.located import Located
from services.steward.measure import Measure
from services.steward.teach import rows_at_once, teach
from shared.catalog.generations import Generation
from shared.catalog.session import Catalog
from shared.estimate.places import same_place
from shared.objects import ObjectStore
from shared.word_weights.compare import is_a_rise, rises_by_chance
from shared.word_weights.learn import Taught
from shared.word_weights.pairs import (
    LEAST_PAIRS,
    NEAREST_M,
    Curriculum,
    TaughtBy,
    choose_pairs,
)
from shared.word_weights.record import HeldOut, Outcome, WordWeights

DIGITS = 6  # of a weight, as it is stored
RANKS = 10  # looked at for R@10
MOST_BURST = 200  # photos that are left out with one: more are a fixed camera's, and not asked with


class LearnWords:
    """Learns the weights of one generation with `words` words in its vocabulary."""

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        generation: Generation,
        words: int,
        measure: Measure,
    ) -> None:
        self._catalog = catalog
        self._store = store
        self._generation = generation
        self._words = words
        self._measure = measure

    def run(self, sample: Sequence[Located], seed: int, searchable: int) -> WordWeights:
        """What there is to keep, whatever came of it. `sample` are the photos to try weights on.

        Raises what `Measure` and `teach` raise.
        """
        photos = self._measure.database.photos
        chosen = choose_pairs(
            [photo.spot for photo in photos], seed, rows_at_once(self._generation.dimension)
        )
        halves = self._teach(chosen)
        record = WordWeights(
            outcome=Outcome.NOT_ENOUGH_PAIRS,
            reason=_too_few(chosen.by, halves),
            taught_by=chosen.by,
            near_pairs=sum(half.near.pairs for half in halves),
            far_pairs=sum(half.far.pairs for half in halves),
            seed=seed,
            searchable=searchable,
        )
        if min(min(half.near.pairs, half.far.pairs) for half in halves) < LEAST_PAIRS:
            return record
        together = _as_stored(halves[0] + halves[1])
        of_other_half = (_as_stored(halves[1]), _as_stored(halves[0]))
        half_of = {photo.photo_id: half for photo, half in zip(photos, chosen.halves, strict=True)}
        tried = [(query, of_other_half[half_of[query.photo_id]]) for query in sample]
        held_out = self._try(tried, chosen.by)
        kept = is_a_rise(held_out.better, held_out.worse)
        record = record.model_copy(
            update={
                "outcome": Outcome.KEPT if kept else Outcome.NOT_KEPT,
                "reason": _what_came_of_it(held_out),
                "weights": together,
                "held_out": held_out,
            }
        )
        if kept:
            measured = self._measure.run(sample, together)
            record = record.model_copy(update={"calibration": measured.calibration})
        return record

    def _teach(self, chosen: Curriculum) -> tuple[Taught, Taught]:
        ids = [photo.photo_id for photo in self._measure.database.photos]

        def half(lessons: int) -> Taught:
            return teach(
                self._catalog,
                self._store,
                self._generation.id,
                ids,
                chosen.lessons[lessons],
                self._words,
                self._measure.on_asked,
            )

        return half(0), half(1)

    def _try(self, sample: Sequence[tuple[Located, tuple[float, ...]]], by: TaughtBy) -> HeldOut:
        """Each photo that is not alone at its place, asked without weights and with these."""
        without, weighted, better, worse = Recall(), Recall(), 0, 0
        for query, weights in sample:
            self._measure.on_asked()
            burst = self._burst(query, by)
            if burst is None:
                continue
            plain, found = self._right(query, (), burst), self._right(query, weights, burst)
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
            chance=rises_by_chance(better, worse),
        )

    def _burst(self, query: Located, by: TaughtBy) -> tuple[UUID, ...] | None:
        """What is left out with the photo; None where nothing of its place would be left."""
        database, radius_m = self._measure.database, self._measure.radius_m
        if by == TaughtBy.PLACES:
            return () if database.showing(query.spot, radius_m) > 1 else None  # itself is one
        burst = database.within(query.spot, NEAREST_M)  # itself among them
        alone = len(database.within(query.spot, radius_m)) == len(burst)
        return None if alone or len(burst) > MOST_BURST else tuple(burst)

    def _right(
        self, query: Located, weights: tuple[float, ...], without: tuple[UUID, ...]
    ) -> list[bool] | None:
        """Which photos of the ranking show the query's place; None for a deleted query."""
        ranking = self._measure.asker.ask(query, RANKS, weights, without)
        if ranking is None:
            return None
        return [same_place(query.spot, spot, self._measure.radius_m) for _, spot in ranking]


def _as_stored(taught: Taught) -> tuple[float, ...]:
    return tuple(round(weight, DIGITS) for weight in taught.weights().tolist())


def _too_few(by: TaughtBy, halves: tuple[Taught, Taught]) -> str:
    near, far = ([half.near.pairs for half in halves], [half.far.pairs for half in halves])
    what = "5 to 25 m apart" if by == TaughtBy.COORDINATES else "under one label"
    return (
        f"By {by} the two halves of the map have {near[0]} and {near[1]} pairs of photos of one "
        f"place ({what}) and {far[0]} and {far[1]} of two places; {LEAST_PAIRS} of either kind are "
        "needed in each half."
    )


def _what_came_of_it(held_out: HeldOut) -> str:
    return (
        f"Of {held_out.without['queries']} photos, each asked with what the other half of the map "
        f"has taught, {held_out.better} find their place first with weights alone and "
        f"{held_out.worse} without them alone (by chance: p = {held_out.chance:.2g})."
    )
