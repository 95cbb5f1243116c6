"""Matches of local features: how many points of the query each of the best photos shows as well."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from uuid import UUID

from services.gateway.dependencies import GatewayContext
from services.gateway.similarity.search_params import SearchParams
from shared.catalog.chunks import find_feature_rows
from shared.catalog.generations import Generation
from shared.catalog.maps import Map, Matching
from shared.errors import PlacewiseError, Unprocessable
from shared.evaluation.places.evidence import RankedPhoto, match_support
from shared.responses.similarity import MatchesResponse, PointPair
from shared.search_api.protocol import (
    FeatureReference,
    MatchRequest,
    MatchResponse,
    PhotoMatches,
    SearchHit,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class QueryMatches:
    """The matches of a query with the photos that were compared."""

    photos: Mapping[UUID, PhotoMatches]
    response: MatchesResponse | None = None
    """None if no photo was to be compared."""

    def inliers(self, photo_id: UUID) -> int | None:
        """Return the number of matching points; None if the photo was not compared."""
        matches = self.photos.get(photo_id)
        return None if matches is None else matches.inliers

    def pairs(self, photo_id: UUID) -> list[PointPair] | None:
        """Return the matching points; None if the photo was not compared."""
        matches = self.photos.get(photo_id)
        return None if matches is None else list(matches.pairs)

    def add_to(self, ranking: Sequence[RankedPhoto]) -> list[RankedPhoto]:
        """Return the ranking, in its order, with the match support of its photos."""
        return [
            replace(ranked, support=match_support(found.matches, found.inliers))
            if isinstance(ranked.photo, UUID) and (found := self.photos.get(ranked.photo))
            else ranked
            for ranked in ranking
        ]

    def rerank(self, hits: Sequence[SearchHit], count: int) -> list[SearchHit]:
        """Sort the first `count` hits by their inliers; those without are listed after them."""

        def order(hit: SearchHit) -> int:
            inliers = self.inliers(hit.photo_id)
            return 1 if inliers is None else -inliers

        return [*sorted(hits[:count], key=order), *hits[count:]]


NO_MATCHES = QueryMatches({})
MATCHING_IS_OFF = QueryMatches(
    {},
    MatchesResponse(
        compared=0,
        missing=0,
        reason="The map has no local features: its `matching` is off.",
        query_width=None,
        query_height=None,
    ),
)


def check_matching_enabled(map_: Map, search_params: SearchParams) -> None:
    """Raise Unprocessable (`matching_off`) if the request needs matches, and the map has none."""
    if map_.matching == Matching.OFF and (search_params.rerank or search_params.explain):
        raise Unprocessable(
            "matching_off",
            f"The map {map_.name} has no local features to match: its `matching` is off. Leave "
            "out `rerank` and `explain`, or turn matching on.",
        )


def match_photos(
    gateway: GatewayContext,
    generation: Generation,
    query: FeatureReference,
    photo_ids: Sequence[UUID],
    with_pairs: bool,
) -> QueryMatches:
    """Match a query with photos of the generation.

    A query that can't be matched now is answered without matches, and with the reason.
    """
    with gateway.catalog.read() as session:
        rows = find_feature_rows(session, generation.id, photo_ids)
    candidates = tuple(FeatureReference(object_key=key, row=row) for key, row in rows.values())
    found = MatchResponse(candidates=(), reason="None of the photos has local features yet.")
    if candidates:
        request = MatchRequest(query=query, candidates=candidates, with_pairs=with_pairs)
        try:
            found = gateway.search.match(request)
        except PlacewiseError as error:
            log.warning("a query is answered without matches: %s", error)
            found = MatchResponse(candidates=(), reason=error.detail)
    photos = {
        photo_id: matches
        for photo_id, matches in zip(rows, found.candidates, strict=False)
        if matches is not None
    }
    width, height = found.query_size or (None, None)
    return QueryMatches(
        photos,
        MatchesResponse(
            compared=len(photos),
            missing=len(photo_ids) - len(photos),
            reason=found.reason,
            query_width=width,
            query_height=height,
        ),
    )
