"""Map evaluation: recall, calibration and false accepts of a live map, through the search tier.

*Leave-one-out*: each photo of a sample of the map is searched, itself excluded. Photos of one
session resemble each other, so the recall is optimistic; use it to compare two generations of a
map. *Labelled queries* (photos of role `query`) were taken at another time: their recall is what
users see.

Word weights change the ranking and the meaning of its scores: a calibration is valid only for
results with the weights that it was measured with.
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
    """Recall@k over queries that have a true positive."""

    queries: int = 0
    hits: dict[int, int] = field(default_factory=lambda: dict.fromkeys(RECALL_RANKS, 0))
    """k -> queries with a true positive among the first k."""

    def add(self, correct: Sequence[bool]) -> None:
        """Add a query: for each result, best first, whether it shows the query's place."""
        self.queries += 1
        for rank in RECALL_RANKS:
            self.hits[rank] += any(correct[:rank])

    def figures(self) -> dict[str, Any]:
        return {
            "queries": self.queries,
            **{f"R@{k}": ratio(hits, self.queries) for k, hits in self.hits.items()},
        }


@dataclass(frozen=True, slots=True)
class QueryOutcome:
    """The result of one labelled query."""

    in_map: bool
    """Whether the map has a photo of its place."""
    evidence: PlaceEvidence | None
    is_correct: bool
    """Whether the estimate shows its place."""
    error_m: float | None
    same_session: bool
    """Taken within SAME_SESSION_PERIOD of the photo that it matched: excluded from calibration."""
    accepted: bool | None


@dataclass(slots=True)
class LabelledQueryMetrics:
    """Metrics over all labelled queries of an evaluation."""

    recall: RecallCounter = field(default_factory=RecallCounter)
    outcomes: list[QueryOutcome] = field(default_factory=list)

    def confidence_samples(self) -> list[tuple[PlaceEvidence, bool]]:
        """Return (evidence, is correct) of the queries that were taken in another session."""
        return [
            (o.evidence, o.is_correct)
            for o in self.outcomes
            if o.evidence is not None and not o.same_session
        ]

    def figures(self) -> dict[str, Any]:
        """Return the metrics as JSON.

        Recall is over queries whose place is in the map, the other metrics are over all. Those of
        the confidence are cross-validated: the confidence of a query is fitted on the others.
        """
        inside = [o for o in self.outcomes if o.in_map]
        outside = [o for o in self.outcomes if not o.in_map]
        errors = [o.error_m for o in inside if o.is_correct and o.error_m is not None]
        return {
            **self.recall.figures(),
            "out_of_map": len(outside),
            "same_session": sum(o.same_session for o in self.outcomes),
            "median_error_of_right_ones_m": median(errors) if errors else None,
            "accepted_in_map": ratio(sum(bool(o.accepted) for o in inside), len(inside)),
            "right_of_accepted": ratio(
                sum(o.is_correct for o in self.outcomes if o.accepted),
                sum(bool(o.accepted) for o in self.outcomes),
            ),
            "false_accepts": ratio(sum(bool(o.accepted) for o in outside), len(outside)),
            **self._confidence(),
        }

    def _confidence(self) -> dict[str, Any]:
        samples = self.confidence_samples()
        predicted = cross_validate(samples)
        if predicted is None:
            return {"calibration_error": None, "auroc": None, "recall_at_99_precision": None}
        is_correct = [correct for _, correct in samples]
        findable = sum(o.in_map and not o.same_session for o in self.outcomes)
        return {
            "calibration_error": expected_calibration_error(predicted, is_correct),
            "auroc": auroc(predicted, is_correct),
            "recall_at_99_precision": recall_at_precision(predicted, is_correct, findable),
        }


def ratio(part: int, total: int) -> float | None:
    """Return `part / total`; None if the total is 0."""
    return part / total if total else None


MAX_RANKS = 800  # depth of the search for other places where hundreds of photos show the same one

# A match taken less than this before or after the query belongs to the same session.
SAME_SESSION_PERIOD = timedelta(hours=12)


@dataclass(frozen=True, slots=True)
class MapEvaluationResult:
    """The metrics of an evaluation, as JSON, and the calibration fitted on it."""

    figures: dict[str, Any]
    calibration: Calibration


class MapEvaluation:
    """Evaluates one generation of a map.

    Args:
        catalog: The catalog.
        search: The search tier.
        generation: The generation to evaluate.
        radius_m: Photos within this distance, in metres, show the same place.
        on_query: Called after every search; an exception that it raises ends the evaluation.
    """

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
            ids = (generation.map_id, generation.id)
            database = read_geotagged_photos(session, *ids, PhotoRole.DATABASE)
            self.database = GeotaggedPhotos(database)
            self.queries = read_geotagged_photos(session, *ids, PhotoRole.QUERY)
            version = session.get_one(Map, generation.map_id).version
        self._by_id = {photo.photo_id: photo for photo in self.database.photos}
        self.search = EvaluationSearch(catalog, search, generation, version, self._by_id)

    def draw_sample(self, size: int, seed: int) -> list[GeotaggedPhoto]:
        """Draw at most `size` database photos as leave-one-out queries, reproducible by `seed`."""
        photos = self.database.photos
        chosen = np.random.default_rng(seed).choice(
            len(photos), size=min(size, len(photos)), replace=False
        )
        return [photos[index] for index in sorted(chosen.tolist())]

    def evaluate(
        self, sample: Sequence[GeotaggedPhoto], weights: tuple[float, ...] = ()
    ) -> MapEvaluationResult:
        """Search with every photo of the sample and every labelled query, and compute the metrics.

        Args:
            sample: Database photos for the leave-one-out evaluation.
            weights: Word weights of the ranking; empty for an unweighted one.
        """
        rank_photo = partial(self.search.rank_similar, weights=weights)
        recall, impostors, alone = self._leave_one_out(sample, rank_photo)
        threshold = fit_threshold(impostors)
        provisional = Calibration(
            radius_m=self.radius_m,
            support_threshold=threshold,
            impostors=len(impostors),
            labelled_queries=0,
            confidence=None,
        )
        labelled = self._evaluate_labelled_queries(provisional, rank_photo)
        samples = labelled.confidence_samples()
        calibration = provisional.model_copy(
            update={"labelled_queries": len(samples), "confidence": fit_confidence(samples)}
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
        """Return recall, the evidence of impostors, and the number of photos alone at their place.

        An impostor is the best match at another place: what a query outside the map would find.
        """
        recall, impostors, alone = RecallCounter(), [], 0
        for query in sample:
            ranking = rank_photo(query, EVIDENCE_DEPTH)
            self.on_query()
            if ranking is None:
                continue
            if self.database.count_at_place(query.spot, self.radius_m) > 1:  # includes the query
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
        self, query: GeotaggedPhoto, ranking: LocatedRanking, rank_photo: RankPhoto
    ) -> list[RankedPhoto]:
        """Return the ranking as it would be if the query's place were not in the map."""
        depth = EVIDENCE_DEPTH
        while True:
            others = [r for r in _to_ranked(ranking) if is_different_place(query.spot, r.location)]
            if len(others) >= EVIDENCE_DEPTH // 2 or len(ranking) < depth or depth >= MAX_RANKS:
                return others[:EVIDENCE_DEPTH]
            depth *= 2
            ranking = rank_photo(query, depth) or []

    def _evaluate_labelled_queries(
        self, calibration: Calibration, rank_photo: RankPhoto
    ) -> LabelledQueryMetrics:
        labelled = LabelledQueryMetrics()
        for query in self.queries:
            ranking = rank_photo(query, EVIDENCE_DEPTH)
            self.on_query()
            if ranking is None:
                continue
            in_map = self.database.count_at_place(query.spot, self.radius_m) > 0
            if in_map:
                labelled.recall.add(
                    [is_same_place(query.spot, spot, self.radius_m) for _, spot in ranking]
                )
            evidence = compute_evidence(_to_ranked(ranking), self.radius_m)
            estimate = (
                estimate_location(_to_ranked(ranking), self.radius_m)
                if evidence
                else UNKNOWN_LOCATION
            )
            labelled.outcomes.append(
                QueryOutcome(
                    in_map=in_map,
                    evidence=evidence,
                    is_correct=is_same_place(query.spot, estimate, self.radius_m),
                    error_m=distance_between_m(query.spot, estimate),
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
