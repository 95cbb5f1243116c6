"""Asking a live map about photos whose place is known, through the search tier that answers users.

*Leave-one-out*: each of a sample of the map's own photos is asked, itself left out. Photos of one
session resemble each other, so this flatters; it is for comparing two generations of one map.
*Labelled queries* (photos of role `query`) were taken at another time: this is what users see.

With word weights the ranking is another one, and so is what its scores mean: whoever measures says
which weights apply, and what is learnt is good for answers with these alone.

Counting what labelled queries come to: recall, accepted strangers, how good a confidence is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from services.steward.evaluation_search import (
    UNKNOWN_LOCATION,
    EvaluationSearch,
    GeotaggedPhoto,
    GeotaggedPhotos,
    LocatedRanking,
    RankPhoto,
    read_geotagged_photos,
)
from shared.catalog.generations import Generation
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoRole
from shared.catalog.session import Catalog
from shared.evaluation.calibration import (
    Calibration,
    auroc,
    cross_validate,
    expected_calibration_error,
    fit_confidence,
    fit_threshold,
    recall_at_precision,
)
from shared.evaluation.place_evidence import (
    EVIDENCE_DEPTH,
    PlaceEvidence,
    RankedPhoto,
    compute_evidence,
    distance_between_m,
    estimate_location,
    is_different_place,
    is_same_place,
)
from shared.search_api.protocol import SearchBackend, SearchHit

RECALL_RANKS = (1, 5, 10)


@dataclass(slots=True)
class RecallCounter:
    """Counts queries that have a true positive, and whether one came among the first k."""

    queries: int = 0
    found: dict[int, int] = field(default_factory=lambda: dict.fromkeys(RECALL_RANKS, 0))

    def add(self, correct: Sequence[bool]) -> None:
        """One query's ranking, best first: which of them show its place."""
        self.queries += 1
        for rank in RECALL_RANKS:
            self.found[rank] += any(correct[:rank])

    def figures(self) -> dict[str, Any]:
        return {
            "queries": self.queries,
            **{f"R@{k}": ratio(found, self.queries) for k, found in self.found.items()},
        }


@dataclass(frozen=True, slots=True)
class QueryOutcome:
    """What came of one labelled query."""

    in_map: bool
    """Whether the map has a photo of its place."""
    evidence: PlaceEvidence | None
    is_correct: bool
    """Whether the estimate shows its place."""
    error_m: float | None
    same_session: bool
    """Taken within hours of the photo that it matched: no witness of another day."""
    accepted: bool | None


@dataclass(slots=True)
class LabelledQueryMetrics:
    """All labelled queries of an evaluation."""

    recall: RecallCounter = field(default_factory=RecallCounter)
    outcomes: list[QueryOutcome] = field(default_factory=list)

    def confidence_samples(self) -> list[tuple[PlaceEvidence, bool]]:
        """(evidence, was it right) of the queries of another session."""
        return [
            (o.evidence, o.is_correct)
            for o in self.outcomes
            if o.evidence is not None and not o.same_session
        ]

    def figures(self) -> dict[str, Any]:
        """Recall over queries that the map can answer; the rest over all. The confidence's figures
        are cross-validated: each query is judged by what the others have taught."""
        here = [o for o in self.outcomes if o.in_map]
        outside = [o for o in self.outcomes if not o.in_map]
        errors = [o.error_m for o in here if o.is_correct and o.error_m is not None]
        return {
            **self.recall.figures(),
            "out_of_map": len(outside),
            "same_session": sum(o.same_session for o in self.outcomes),
            "median_error_of_right_ones_m": median(errors) if errors else None,
            "accepted_in_map": ratio(sum(bool(o.accepted) for o in here), len(here)),
            "right_of_accepted": ratio(
                sum(o.is_correct for o in self.outcomes if o.accepted),
                sum(bool(o.accepted) for o in self.outcomes),
            ),
            "false_accepts": ratio(sum(bool(o.accepted) for o in outside), len(outside)),
            **self._confidence(),
        }

    def _confidence(self) -> dict[str, Any]:
        judged = self.confidence_samples()
        predicted = cross_validate(judged)
        if predicted is None:
            return {"calibration_error": None, "auroc": None, "recall_at_99_precision": None}
        right = [ok for _, ok in judged]
        findable = sum(o.in_map and not o.same_session for o in self.outcomes)
        return {
            "calibration_error": expected_calibration_error(predicted, right),
            "auroc": auroc(predicted, right),
            "recall_at_99_precision": recall_at_precision(predicted, right, findable),
        }


def ratio(part: int, whole: int) -> float | None:
    """None of nothing."""
    return part / whole if whole else None


MAX_RANKS = 800  # looked at to find what is elsewhere, where hundreds show the same place

# A match taken less than this before or after the query is of the same session.
SAME_SESSION_PERIOD = timedelta(hours=12)


@dataclass(frozen=True, slots=True)
class MapEvaluationResult:
    figures: dict[str, Any]
    calibration: Calibration


class MapEvaluation:
    """Measures one generation. `on_asked` is called after every query; what it raises ends it."""

    def __init__(
        self,
        catalog: Catalog,
        search: SearchBackend,
        generation: Generation,
        radius_m: float,
        on_query: Callable[[], None],
    ) -> None:
        self.radius_m = radius_m
        self.on_query = on_query
        with catalog.read() as session:
            of = (session, generation.map_id, generation.id)
            self.database = GeotaggedPhotos(read_geotagged_photos(*of, PhotoRole.DATABASE))
            self.queries = read_geotagged_photos(*of, PhotoRole.QUERY)
            version = session.get_one(Map, generation.map_id).version
        self._by_id = {photo.photo_id: photo for photo in self.database.photos}
        self.search = EvaluationSearch(catalog, search, generation, version, self._by_id)

    def draw_sample(self, size: int, seed: int) -> list[GeotaggedPhoto]:
        """The photos to leave out, one after the other: at most `size`, drawn from the seed."""
        photos = self.database.photos
        chosen = np.random.default_rng(seed).choice(
            len(photos), size=min(size, len(photos)), replace=False
        )
        return [photos[index] for index in sorted(chosen.tolist())]

    def evaluate(
        self, sample: Sequence[GeotaggedPhoto], weights: tuple[float, ...] = ()
    ) -> MapEvaluationResult:
        """Ask with every photo of the sample and with every labelled query, ranked by the word
        weights where there are any."""
        ask = partial(self.search.rank_similar, weights=weights)
        recall, impostors, alone = self._leave_one_out(sample, ask)
        threshold = fit_threshold(impostors)
        provisional = Calibration(
            radius_m=self.radius_m,
            support_threshold=threshold,
            impostors=len(impostors),
            labelled_queries=0,
            confidence=None,
        )
        labelled = self._evaluate_labelled_queries(provisional, ask)
        judged = labelled.confidence_samples()
        calibration = provisional.model_copy(
            update={"labelled_queries": len(judged), "confidence": fit_confidence(judged)}
        )
        figures = {
            "radius_m": self.radius_m,
            "leave_one_out": {**recall.figures(), "without_positive": alone},
            "labelled_queries": labelled.figures() if self.queries else None,
            "estimate": {
                "support_threshold": threshold,
                "impostors": len(impostors),
                "calibration": calibration.state,
            },
        }
        return MapEvaluationResult(figures, calibration)

    def _leave_one_out(
        self, sample: Sequence[GeotaggedPhoto], rank_photo: RankPhoto
    ) -> tuple[RecallCounter, list[PlaceEvidence], int]:
        """Recall, the evidence of impostors, and how many photos are alone at their place."""
        recall, impostors, alone = RecallCounter(), [], 0
        for query in sample:
            ranking = rank_photo(query, EVIDENCE_DEPTH)
            self.on_query()
            if ranking is None:
                continue
            if self.database.count_at_place(query.spot, self.radius_m) > 1:  # itself is one of them
                recall.add([is_same_place(query.spot, spot, self.radius_m) for _, spot in ranking])
            else:
                alone += 1
            evidence = compute_evidence(
                self._other_places(query, ranking, rank_photo), self.radius_m
            )
            if evidence is not None:
                impostors.append(evidence)
        return recall, impostors, alone

    def _other_places(
        self, query: GeotaggedPhoto, ranking: LocatedRanking, ask: RankPhoto
    ) -> list[RankedPhoto]:
        """The ranking as it would be if the query's place were not in the map."""
        depth = EVIDENCE_DEPTH
        while True:
            strangers = [
                r for r in _to_ranked(ranking) if is_different_place(query.spot, r.location)
            ]
            if len(strangers) >= EVIDENCE_DEPTH // 2 or len(ranking) < depth or depth >= MAX_RANKS:
                return strangers[:EVIDENCE_DEPTH]
            depth *= 2
            ranking = ask(query, depth) or []

    def _evaluate_labelled_queries(
        self, calibration: Calibration, ask: RankPhoto
    ) -> LabelledQueryMetrics:
        labelled = LabelledQueryMetrics()
        for query in self.queries:
            ranking = ask(query, EVIDENCE_DEPTH)
            self.on_query()
            if ranking is None:
                continue
            in_map = self.database.count_at_place(query.spot, self.radius_m) > 0
            if in_map:
                labelled.recall.add(
                    [is_same_place(query.spot, spot, self.radius_m) for _, spot in ranking]
                )
            evidence = compute_evidence(_to_ranked(ranking), self.radius_m)
            found = (
                estimate_location(_to_ranked(ranking), self.radius_m)
                if evidence
                else UNKNOWN_LOCATION
            )
            labelled.outcomes.append(
                QueryOutcome(
                    in_map=in_map,
                    evidence=evidence,
                    is_correct=is_same_place(query.spot, found, self.radius_m),
                    error_m=distance_between_m(query.spot, found),
                    same_session=bool(ranking) and self._same_session(query, ranking[0][0]),
                    accepted=calibration.accepts(evidence) if evidence else None,
                )
            )
        return labelled

    def _same_session(self, query: GeotaggedPhoto, best: SearchHit) -> bool:
        match = self._by_id.get(best.photo_id)
        if match is None or match.captured_at is None or query.captured_at is None:
            return False
        return abs(match.captured_at - query.captured_at) < SAME_SESSION_PERIOD


def _to_ranked(ranking: LocatedRanking) -> list[RankedPhoto]:
    return [RankedPhoto(hit.ranked_by, spot) for hit, spot in ranking]
