"""Asking a live map about photos whose place is known, through the search tier that answers users.

*Leave-one-out*: each of a sample of the map's own photos is asked, itself left out. Photos of one
session resemble each other, so this flatters; it is for comparing two generations of one map.
*Labelled queries* (photos of role `query`) were taken at another time: this is what users see.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import numpy as np

from services.steward.labelled import Labelled, Outcome, Recall
from services.steward.located import Located, LocatedPhotos, read_located
from shared.catalog.chunks import descriptor_of
from shared.catalog.generations import Generation
from shared.catalog.maps import Map
from shared.catalog.photos import PhotoRole
from shared.catalog.session import Catalog
from shared.errors import Conflict, Gone, Unavailable
from shared.estimate.calibration import Calibration, learn_confidence, learn_threshold
from shared.estimate.evidence import DEPTH, Evidence, Ranked, locate, weigh
from shared.estimate.places import Spot, elsewhere, metres_between, same_place
from shared.search_protocol import Hit, SearchPort, SearchRequest
from shared.shards import names_a_shard

MOST_RANKS = 800  # looked at to find what is elsewhere, where hundreds show the same place

# A match taken less than this before or after the query is of the same session.
SESSION = timedelta(hours=12)

TRIES = 2

UNKNOWN = Spot(None, None, None)


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
        self._catalog = catalog
        self._search = search
        self._generation = generation
        self._radius_m = radius_m
        self._on_asked = on_asked
        with catalog.read() as session:
            of = (session, generation.map_id, generation.id)
            self._database = LocatedPhotos(read_located(*of, PhotoRole.DATABASE))
            self.queries = read_located(*of, PhotoRole.QUERY)
            self._version = session.get_one(Map, generation.map_id).version
        self._by_id = {photo.photo_id: photo for photo in self._database.photos}

    def sample(self, size: int, seed: int) -> list[Located]:
        """The photos to leave out, one after the other: at most `size`, drawn from the seed."""
        photos = self._database.photos
        chosen = np.random.default_rng(seed).choice(
            len(photos), size=min(size, len(photos)), replace=False
        )
        return [photos[index] for index in sorted(chosen.tolist())]

    def run(self, sample: Sequence[Located]) -> Measured:
        """Ask with every photo of the sample and with every labelled query."""
        recall, impostors, alone = self._leave_one_out(sample)
        threshold = learn_threshold(impostors)
        provisional = Calibration(
            radius_m=self._radius_m,
            support_threshold=threshold,
            impostors=len(impostors),
            labelled_queries=0,
            confidence=None,
        )
        labelled = self._ask_labelled(provisional)
        judged = labelled.judged()
        calibration = provisional.model_copy(
            update={"labelled_queries": len(judged), "confidence": learn_confidence(judged)}
        )
        figures = {
            "radius_m": self._radius_m,
            "leave_one_out": {**recall.figures(), "without_positive": alone},
            "labelled_queries": labelled.figures() if self.queries else None,
            "estimate": {
                "support_threshold": threshold,
                "impostors": len(impostors),
                "calibration": calibration.state,
            },
        }
        return Measured(figures, calibration)

    def _leave_one_out(self, sample: Sequence[Located]) -> tuple[Recall, list[Evidence], int]:
        """Recall, the evidence of impostors, and how many photos are alone at their place."""
        recall, impostors, alone = Recall(), [], 0
        for query in sample:
            ranking = self._ask(query, DEPTH)
            self._on_asked()
            if ranking is None:
                continue
            if self._database.showing(query.spot, self._radius_m) > 1:  # itself is one of them
                recall.add([same_place(query.spot, spot, self._radius_m) for _, spot in ranking])
            else:
                alone += 1
            evidence = weigh(self._strangers(query, ranking), self._radius_m)
            if evidence is not None:
                impostors.append(evidence)
        return recall, impostors, alone

    def _strangers(self, query: Located, ranking: list[tuple[Hit, Spot]]) -> list[Ranked]:
        """The ranking as it would be if the query's place were not in the map."""
        depth = DEPTH
        while True:
            strangers = [r for r in _ranked(ranking) if elsewhere(query.spot, r.spot)]
            if len(strangers) >= DEPTH // 2 or len(ranking) < depth or depth >= MOST_RANKS:
                return strangers[:DEPTH]
            depth *= 2
            ranking = self._ask(query, depth) or []

    def _ask_labelled(self, calibration: Calibration) -> Labelled:
        labelled = Labelled()
        for query in self.queries:
            ranking = self._ask(query, DEPTH)
            self._on_asked()
            if ranking is None:
                continue
            in_map = self._database.showing(query.spot, self._radius_m) > 0
            if in_map:
                labelled.recall.add(
                    [same_place(query.spot, spot, self._radius_m) for _, spot in ranking]
                )
            evidence = weigh(_ranked(ranking), self._radius_m)
            found = locate(_ranked(ranking), self._radius_m) if evidence else UNKNOWN
            labelled.outcomes.append(
                Outcome(
                    in_map=in_map,
                    evidence=evidence,
                    right=same_place(query.spot, found, self._radius_m),
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

    def _ask(self, query: Located, k: int) -> list[tuple[Hit, Spot]] | None:
        """The k most similar database photos and their spots, without the query itself; None for
        a query that was deleted since. Conflict (`map_damaged`) when a part can't be searched."""
        for attempt in range(1, TRIES + 1):
            with self._catalog.read() as session:
                found = descriptor_of(session, self._generation.id, query.photo_id)
            if found is None:
                return None
            descriptor, chunk = found
            request = SearchRequest(
                map_id=self._generation.map_id,
                generation_id=self._generation.id,
                object_key=chunk.object_key,
                row=descriptor.row,
                min_version=self._version,
                k=k,
                exclude=(query.photo_id,),
            )
            try:
                answer = self._search.search(request)
            except Gone:  # its chunk was merged into another between the two calls
                if attempt == TRIES:
                    raise
                continue
            except Unavailable as error:
                if error.code == "chunk_unreadable":
                    raise _damaged([chunk.object_key]) from error
                raise
            if any(names_a_shard(part) for part in answer.missing):
                raise Unavailable(
                    "search_incomplete",
                    f"Without {', '.join(answer.missing)} the figures would be those of a part "
                    "of the map.",
                )
            if answer.missing:
                raise _damaged(answer.missing)
            return [(hit, self._spot(hit)) for hit in answer.hits]
        raise AssertionError("the last try returns or raises")

    def _spot(self, hit: Hit) -> Spot:
        found = self._by_id.get(hit.photo_id)
        return found.spot if found else UNKNOWN


def _damaged(missing: Sequence[str]) -> Conflict:
    return Conflict(
        "map_damaged",
        f"{', '.join(missing)} can't be read, and figures of a part of the map would mislead. "
        "Restore it from a backup, or describe its photos again, then evaluate.",
    )


def _ranked(ranking: Sequence[tuple[Hit, Spot]]) -> list[Ranked]:
    return [Ranked(hit.score, spot) for hit, spot in ranking]
