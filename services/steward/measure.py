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

from services.steward.ask import UNKNOWN, Ask, Asker, Ranking
from services.steward.labelled import Labelled, Outcome, Recall
from services.steward.located import Located, LocatedPhotos, read_located
from shared.catalog.generations import Generation
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoRole
from shared.catalog.session import Catalog
from shared.estimate.calibration import Calibration, learn_confidence, learn_threshold
from shared.estimate.evidence import DEPTH, Evidence, Ranked, locate, weigh
from shared.estimate.places import elsewhere, metres_between, same_place
from shared.search_protocol import Hit, SearchPort

MOST_RANKS = 800  # looked at to find what is elsewhere, where hundreds show the same place

# A match taken less than this before or after the query is of the same session.
SESSION = timedelta(hours=12)


@dataclass(frozen=True, slots=True)
class Measured:
    figures: dict[str, Any]
    calibration: Calibration


class Measure:
    """Measures one generation. `on_asked` is called after every query; what it raises ends it."""

    def __init__(
        self,
        catalog: Catalog,
        search: SearchPort,
        generation: Generation,
        radius_m: float,
        on_asked: Callable[[], None],
    ) -> None:
        self.radius_m = radius_m
        self.on_asked = on_asked
        with catalog.read() as session:
            of = (session, generation.map_id, generation.id)
            self.database = LocatedPhotos(read_located(*of, PhotoRole.DATABASE))
            self.queries = read_located(*of, PhotoRole.QUERY)
            version = session.get_one(Map, generation.map_id).version
        self._by_id = {photo.photo_id: photo for photo in self.database.photos}
        self.asker = Asker(catalog, search, generation, version, self._by_id)

    def sample(self, size: int, seed: int) -> list[Located]:
        """The photos to leave out, one after the other: at most `size`, drawn from the seed."""
        photos = self.database.photos
        chosen = np.random.default_rng(seed).choice(
            len(photos), size=min(size, len(photos)), replace=False
        )
        return [photos[index] for index in sorted(chosen.tolist())]

    def run(self, sample: Sequence[Located], weights: tuple[float, ...] = ()) -> Measured:
        """Ask with every photo of the sample and with every labelled query, ranked by the word
        weights where there are any."""
        ask = partial(self.asker.ask, weights=weights)
        recall, impostors, alone = self._leave_one_out(sample, ask)
        threshold = learn_threshold(impostors)
        provisional = Calibration(
            radius_m=self.radius_m,
            support_threshold=threshold,
            impostors=len(impostors),
            labelled_queries=0,
            confidence=None,
        )
        labelled = self._ask_labelled(provisional, ask)
        judged = labelled.judged()
        calibration = provisional.model_copy(
            update={"labelled_queries": len(judged), "confidence": learn_confidence(judged)}
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
        return Measured(figures, calibration)

    def _leave_one_out(
        self, sample: Sequence[Located], ask: Ask
    ) -> tuple[Recall, list[Evidence], int]:
        """Recall, the evidence of impostors, and how many photos are alone at their place."""
        recall, impostors, alone = Recall(), [], 0
        for query in sample:
            ranking = ask(query, DEPTH)
            self.on_asked()
            if ranking is None:
                continue
            if self.database.showing(query.spot, self.radius_m) > 1:  # itself is one of them
                recall.add([same_place(query.spot, spot, self.radius_m) for _, spot in ranking])
            else:
                alone += 1
            evidence = weigh(self._strangers(query, ranking, ask), self.radius_m)
            if evidence is not None:
                impostors.append(evidence)
        return recall, impostors, alone

    def _strangers(self, query: Located, ranking: Ranking, ask: Ask) -> list[Ranked]:
        """The ranking as it would be if the query's place were not in the map."""
        depth = DEPTH
        while True:
            strangers = [r for r in _ranked(ranking) if elsewhere(query.spot, r.spot)]
            if len(strangers) >= DEPTH // 2 or len(ranking) < depth or depth >= MOST_RANKS:
                return strangers[:DEPTH]
            depth *= 2
            ranking = ask(query, depth) or []

    def _ask_labelled(self, calibration: Calibration, ask: Ask) -> Labelled:
        labelled = Labelled()
        for query in self.queries:
            ranking = ask(query, DEPTH)
            self.on_asked()
            if ranking is None:
                continue
            in_map = self.database.showing(query.spot, self.radius_m) > 0
            if in_map:
                labelled.recall.add(
                    [same_place(query.spot, spot, self.radius_m) for _, spot in ranking]
                )
            evidence = weigh(_ranked(ranking), self.radius_m)
            found = locate(_ranked(ranking), self.radius_m) if evidence else UNKNOWN
            labelled.outcomes.append(
                Outcome(
                    in_map=in_map,
                    evidence=evidence,
                    right=same_place(query.spot, found, self.radius_m),
                    error_m=metres_between(query.spot, found),
                    same_session=bool(ranking) and self._same_session(query, ranking[0][0]),
                    accepted=calibration.accepts(evidence) if evidence else None,
                )
            )
        return labelled

    def _same_session(self, query: Located, best: Hit) -> bool:
        match = self._by_id.get(best.photo_id)
        if match is None or match.captured_at is None or query.captured_at is None:
            return False
        return abs(match.captured_at - query.captured_at) < SESSION


def _ranked(ranking: Ranking) -> list[Ranked]:
    return [Ranked(hit.ranked_by, spot) for hit, spot in ranking]
