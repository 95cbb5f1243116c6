"""Asking a live map about photos whose place is known, through the search tier that answers users.

*Leave-one-out*: each of a sample of the map's own photos is asked, itself left out. Photos of one
session resemble each other, so this flatters; it is for comparing two generations of one map.
*Labelled queries* (photos of role `query`) were taken at another time: this is what users see.

With word weights the ranking is another one, and so is what its scores mean: whoever measures says
which weights apply, and what is learnt is good for answers with these alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from typing import Any

import numpy as np

from services.steward.ask import UNKNOWN_LOCATION, EvaluationSearch, LocatedRanking, RankPhoto
from services.steward.labelled import LabelledQueryMetrics, QueryOutcome, RecallCounter
from services.steward.located import GeotaggedPhoto, GeotaggedPhotos, read_geotagged_photos
from shared.catalog.generations import Generation
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoRole
from shared.catalog.session import Catalog
from shared.estimate.calibration import Calibration, fit_confidence, fit_threshold
from shared.estimate.evidence import (
    EVIDENCE_DEPTH,
    PlaceEvidence,
    RankedPhoto,
    compute_evidence,
    estimate_location,
)
from shared.estimate.places import distance_between_m, is_different_place, is_same_place
from shared.search_protocol import SearchBackend, SearchHit

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
            strangers = [r for r in _to_ranked(ranking) if is_different_place(query.spot, r.spot)]
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
