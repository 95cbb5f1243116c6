"""Similarity searches: query the search tier, join the hits with live photos, estimate the place.

Hits are joined with the catalog by photo id. Photos that have just been deleted are dropped, and
the search is repeated with a larger k until k live photos are found or there are no more.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any
from uuid import UUID

from sqlalchemy.exc import IntegrityError, SQLAlchemyError
from sqlalchemy.orm import Session

from services.gateway.dependencies import GatewayContext
from services.gateway.responses import job_url, photo_response
from services.gateway.similarity.estimate import estimate_place, locate_hits, place_at_pose
from services.gateway.similarity.matches import (
    MATCHING_IS_OFF,
    NO_MATCHES,
    QueryMatches,
    check_matching_enabled,
    match_photos,
)
from services.gateway.similarity.pose import find_pose
from services.gateway.similarity.search_params import SearchParams
from shared.catalog.chunks import find_descriptor
from shared.catalog.database.errors import to_unavailable
from shared.catalog.generations import Generation, RowType, active_generation
from shared.catalog.maps import (
    Map,
    Matching,
    Search,
    get_map,
    map_not_found_error,
    recent_best_scores,
)
from shared.catalog.photos import Photo, get_live_photos, get_photo
from shared.catalog.vocabularies import vocabulary_standing
from shared.errors import Conflict, Gone, PlacewiseError, StorageFull
from shared.evaluation.places.evidence import EVIDENCE_DEPTH, RankedPhoto
from shared.evaluation.places.levels import LevelScheme
from shared.evaluation.places.probability import ELSEWHERE_SHARE, PlaceModel
from shared.jobs import Job, JobState
from shared.responses.similarity import EstimateResponse, SimilarityResponse, SimilarPhotoResponse
from shared.search_api.photo_filter import NO_FILTER, PhotoFilter
from shared.search_api.protocol import (
    FeatureReference,
    RowReference,
    SearchHit,
    SearchRequest,
    SearchResponse,
)
from shared.storage.chunks import features_key

log = logging.getLogger(__name__)

WITH_PLACE = PhotoFilter(has_place=True)
HINTED_PHOTOS = 10  # half of those that a pose is computed from: a hint may be wrong


@dataclass(frozen=True, slots=True)
class SimilarityQuery:
    """The descriptor to search with, the generation to search in, and fields of the response."""

    map: Map
    generation: Generation
    vocabulary: str
    object_key: str
    row: int
    photo_id: UUID | None
    filename: str
    focal_length: float | None = None
    """From the photo's EXIF, as a multiple of its longer side; None if it is not known"""
    camera_key: str | None = None
    """Of a query photo: `PhotoHeader.camera_key`"""
    quarter_turns: int = 0
    """Clockwise, by which the query photo was turned upright"""
    background: tuple[RowReference, ...] = ()
    """Descriptors whose mean is subtracted from the query"""

    @property
    def features(self) -> FeatureReference:
        """The query's local features; they may not exist."""
        return FeatureReference(object_key=features_key(self.object_key), row=self.row)


def query_from_photo(gateway: GatewayContext, map_name: str, photo_id: UUID) -> SimilarityQuery:
    """Create the query for a stored photo.

    Raises:
        NotFound: `map_not_found`, `photo_not_found`.
        Conflict: `not_searchable`, if the photo has no descriptor yet.
    """
    with gateway.catalog.read() as session:
        map_ = get_map(session, map_name)
        photo = get_photo(session, map_.id, photo_id)
        generation = active_generation(session, map_.id)
        located = find_descriptor(session, generation.id, photo.id) if generation else None
        if generation is None or located is None:
            raise _not_searchable_error(session, photo, map_name)
        descriptor, chunk = located
        return SimilarityQuery(
            map=map_,
            generation=generation,
            vocabulary=vocabulary_standing(session, generation),
            object_key=chunk.object_key,
            row=descriptor.row,
            photo_id=photo.id,
            filename=photo.filename,
            focal_length=photo.focal_length,
        )


def query_from_job(gateway: GatewayContext, job: Job) -> SimilarityQuery:
    """Create the query for a described query photo.

    Raises:
        Gone: `query_expired`, if the generation of its descriptor was deleted.
    """
    result: dict[str, Any] = job.result or {}
    with gateway.catalog.read() as session:
        map_ = session.get_one(Map, job.map_id)
        generation = session.get(Generation, UUID(result["generation_id"]))
        if generation is None:
            raise Gone(
                "query_expired", "The generation of the query was deleted. Send the photo again."
            )
        return SimilarityQuery(
            map=map_,
            generation=generation,
            vocabulary=vocabulary_standing(session, generation),
            object_key=result["object_key"],
            row=result["row"],
            photo_id=None,
            filename=job.params["filename"],
            focal_length=job.params.get("focal_length"),
            camera_key=job.params.get("camera_key"),
            quarter_turns=job.params.get("quarter_turns") or 0,
        )


def find_similar(
    gateway: GatewayContext, query: SimilarityQuery, search_params: SearchParams
) -> SimilarityResponse:
    """Find the most similar live photos and the place estimate, and add the search history row.

    The query itself is not among the photos. If the disk of the catalog is full, the history row is
    left out.

    Raises:
        NotFound: `map_not_found` if the map was deleted meanwhile.
        Unprocessable: `matching_off`.
    """
    response, history = run_similarity_search(gateway, query, search_params)
    if not search_params.history:
        return response
    try:
        with gateway.catalog.write() as session:
            session.add(history)
    except IntegrityError:
        with gateway.catalog.read() as session:
            if session.get(Map, query.map.id) is None:
                raise map_not_found_error(query.map.name) from None
        raise
    except SQLAlchemyError as error:
        if not isinstance(to_unavailable(error), StorageFull):
            raise
        log.warning("the search is not added to the history: the disk of the catalog is full")
    return response


def run_similarity_search(
    gateway: GatewayContext, query: SimilarityQuery, search_params: SearchParams
) -> tuple[SimilarityResponse, Search]:
    """Rank the photos, match the best ones, estimate place and pose, make response and history row.

    One search answers most queries. Further ones are made for photos without a place among the
    first, for a filter (the estimate is that of the whole map), and for the neighbours of a best
    photo that are not cached.
    """
    started = time.perf_counter()
    check_matching_enabled(query.map, search_params)
    search = _MapSearch(gateway, query)
    rankings = _rank_photos(search, search_params)
    matches = _match_best_photos(search, rankings, search_params)
    estimate, probabilities = _estimate(search, rankings, matches, search_params)
    candidates = _pose_candidates(search, rankings, search_params)
    pose = no_pose = None
    try:
        pose = find_pose(gateway, query, candidates, search_params, estimate)
    except PlacewiseError as error:
        no_pose = error.detail
    similar = rankings.similar
    if pose is not None:
        estimate = place_at_pose(estimate, pose)
    hits = matches.rerank(similar.hits, search_params.rerank or 0)[: search_params.top_k]
    images = [
        photo_response(
            SimilarPhotoResponse,
            similar.photos[hit.photo_id],
            query.map.name,
            similarity_score=hit.score,
            match_probability=probabilities.get(hit.photo_id),
            inliers=matches.inliers(hit.photo_id),
            pairs=matches.pairs(hit.photo_id) if search_params.explain else None,
        )
        for hit in hits
    ]
    response = SimilarityResponse.of_row(
        similar.response,
        query_file_id=query.photo_id,
        query_filename=query.filename,
        processing_time_ms=(time.perf_counter() - started) * 1000,
        total_similar=len(images),
        similar_images=images,
        matches_without_place=sum(one.latitude is None and one.place is None for one in images),
        estimate=estimate,
        matches=matches.response,
        pose=pose,
        no_pose=no_pose,
        vocabulary=query.vocabulary,
        generation_id=query.generation.id,
        rows=RowType(query.generation.row_type),
        degraded=bool(similar.response.missing),
    )
    return response, _make_history(query, search_params, rankings.found, response)


@dataclass(frozen=True, slots=True)
class _Found:
    """Live photos that a search found."""

    hits: list[SearchHit]
    """most similar first"""
    photos: dict[UUID, Photo]
    response: SearchResponse
    ranking: list[RankedPhoto]
    """the hits with the locations of their photos"""


@dataclass(frozen=True, slots=True)
class _Rankings:
    """The rankings that a response is made of."""

    found: _Found
    """the photos that pass the filter, at least EVIDENCE_DEPTH if there are as many"""
    located: _Found
    """those of them that have a place"""
    whole_map: _Found
    """photos with a place, whatever the filter"""
    similar: _Found
    """the photos to return, or to choose from by their matches"""


@dataclass(frozen=True, slots=True)
class _MapSearch:
    """Searches with one query."""

    gateway: GatewayContext
    query: SimilarityQuery

    def find(self, photos: PhotoFilter, depth: int) -> _Found:
        """Return the first `depth` live photos; fewer if there are no more."""
        k, query = depth, self.query
        while True:
            response = self.gateway.search.search(
                SearchRequest(
                    generation_id=query.generation.id,
                    object_key=query.object_key,
                    row=query.row,
                    min_version=query.map.version,
                    k=k,
                    photos=photos,
                    exclude=(query.photo_id,) if query.photo_id else (),
                    background=query.background,
                )
            )
            with self.gateway.catalog.read() as session:
                live = get_live_photos(session, [hit.photo_id for hit in response.hits])
            hits = [hit for hit in response.hits if hit.photo_id in live]
            if len(hits) >= depth or len(response.hits) < k:
                hits = hits[:depth]
                return _Found(hits, live, response, locate_hits(hits, live))
            k *= 2

    def rank_neighbours(self, photo_id: UUID) -> Sequence[RankedPhoto]:
        """Return the ranking of the map by one of its photos, best first.

        It is cached: queries that show the same places have the same best photos, and each of them
        would cost a second search of the whole map. A ranking that lacks a part of the map is not
        cached.
        """
        gateway, query = self.gateway, self.query
        key = (query.generation.id, query.map.version, photo_id)
        with gateway.neighbours_lock:
            cached = gateway.neighbours.get(key)
        if cached is not None:
            return cached
        with gateway.catalog.read() as session:
            located = find_descriptor(session, query.generation.id, photo_id)
        if located is None:  # deleted since
            return ()
        descriptor, chunk = located
        photo = replace(query, object_key=chunk.object_key, row=descriptor.row, photo_id=photo_id)
        try:
            found = replace(self, query=photo).find(WITH_PLACE, EVIDENCE_DEPTH + 1)
        except Gone:  # its chunk was merged into another one between the two reads
            return ()
        if not found.response.missing:
            with gateway.neighbours_lock:
                gateway.neighbours[key] = found.ranking
        return found.ranking


def _rank_photos(search: _MapSearch, search_params: SearchParams) -> _Rankings:
    # The estimate needs EVIDENCE_DEPTH hits, also those below `min_score`.
    photo_filter = search_params.photos
    depth = max(search_params.top_k, search_params.rerank or 0)
    found = search.find(photo_filter, max(depth, EVIDENCE_DEPTH))
    located = found
    if not all(ranked.location.is_known for ranked in found.ranking):
        with_place = photo_filter.model_copy(update={"has_place": True})
        located = search.find(with_place, len(found.hits))
    whole_map = located if photo_filter.is_empty else search.find(WITH_PLACE, EVIDENCE_DEPTH)
    least = -1.0 if search_params.min_score is None else search_params.min_score
    similar = [hit for hit in found.hits[:depth] if hit.score >= least]
    return _Rankings(found, located, whole_map, replace(found, hits=similar))


def _pose_candidates(
    search: _MapSearch, rankings: _Rankings, search_params: SearchParams
) -> list[SearchHit]:
    """Return the photos that may show what the query shows: those of its hint come first."""
    hits = rankings.found.hits
    if search_params.hint is not None:
        there = search_params.photos.model_copy(update={"near": search_params.hint})
        hits = [*search.find(there, HINTED_PHOTOS).hits, *hits]
    return list({hit.photo_id: hit for hit in hits}.values())


def _match_best_photos(
    search: _MapSearch, rankings: _Rankings, search_params: SearchParams
) -> QueryMatches:
    """Match the best photos of the result and, where they count, of the estimate."""
    query = search.query
    is_on = query.map.matching != Matching.OFF
    are_evidence = is_on and bool(query.generation.uses_matches)
    count = search_params.photos_to_match(by_default=are_evidence)
    if count == 0:
        return NO_MATCHES
    if not is_on:
        return MATCHING_IS_OFF
    best = [rankings.found, rankings.similar, *([rankings.whole_map] if are_evidence else [])]
    photo_ids = dict.fromkeys(hit.photo_id for ranking in best for hit in ranking.hits[:count])
    return match_photos(
        search.gateway, query.generation, query.features, list(photo_ids), search_params.explain
    )


def _estimate(
    search: _MapSearch,
    rankings: _Rankings,
    matches: QueryMatches,
    search_params: SearchParams,
) -> tuple[EstimateResponse, dict[UUID, float]]:
    """Return the place estimate, and the probabilities that photos show the query's place."""
    query, settings = search.query, search.gateway.settings
    found, whole_map = rankings.found, rankings.whole_map
    model, scheme = _place_model(search)
    certainty, guarantee = search_params.certainty or settings.certainty, search_params.guarantee
    model.threshold(certainty, guarantee)  # refuses a guarantee also where nothing is found
    elsewhere = search_params.elsewhere or query.map.elsewhere or ELSEWHERE_SHARE
    neighbours = search.rank_neighbours(whole_map.hits[0].photo_id) if whole_map.hits else ()
    places = model.estimate(
        matches.add_to(whole_map.ranking),
        [ranked for ranked in neighbours if ranked.photo != query.photo_id],
        scheme,
        certainty,
        settings.estimate_radius_m,
        matches.add_to(rankings.located.ranking),
        elsewhere,
        guarantee,
    )
    similar = locate_hits(rankings.similar.hits[: search_params.top_k], rankings.similar.photos)
    if not any(ranked.location.is_known for ranked in similar):
        places = None  # the photos that it would be named after do not look like the query
    elif (
        places is not None
        and model.is_fitted
        and any(
            model.may_lack_place(places, ranked.score, elsewhere)
            for ranked in takewhile(lambda each: not each.location.is_known, found.ranking)
        )
    ):
        places = None  # the map shows its place, and does not know where that is
    reason = _no_place_reason(found.hits, search_params.photos)
    is_new = places is not None and _is_new(search, model)
    estimate = estimate_place(places, certainty, elsewhere, reason, is_new=is_new)
    if places is None or not model.is_fitted:
        return estimate, {}
    best = (hit.photo_id for hit in rankings.located.hits)
    return estimate, dict(zip(best, places.match_probabilities, strict=True))


def _is_new(search: _MapSearch, model: PlaceModel) -> bool:
    """Return whether the recent queries of the map are new to it."""
    if not model.best_scores:  # the map was not evaluated since scores are kept
        return False
    with search.gateway.catalog.read() as session:
        recent = recent_best_scores(session, search.query.map.id, search.query.generation.id)
    return model.is_new(recent)


def _place_model(search: _MapSearch) -> tuple[PlaceModel, LevelScheme]:
    """Return the model of the map's estimates, and its levels."""
    scheme = LevelScheme(
        labels_are_paths=search.query.map.place_labels_are_paths,
        radii_m=search.gateway.settings.level_radii_m,
    )
    stored = search.query.generation.calibration
    model = PlaceModel.model_validate(stored) if stored else PlaceModel()
    return model.for_scheme(scheme), scheme


def _make_history(
    query: SimilarityQuery,
    search_params: SearchParams,
    found: _Found,
    response: SimilarityResponse,
) -> Search:
    estimate = response.estimate
    return Search(
        map_id=query.map.id,
        generation_id=query.generation.id,
        query_photo_id=query.photo_id,
        query_filename=query.filename,
        top_k=search_params.top_k,
        results=response.total_similar,
        processing_ms=response.processing_time_ms,
        best_score=found.hits[0].score if found.hits else None,
        in_map=estimate.in_map,
        answer_level=estimate.answer_level,
        not_in_map_probability=estimate.not_in_map_probability,
        has_place=estimate.has_place,
    )


def _no_place_reason(hits: Sequence[SearchHit], photo_filter: PhotoFilter) -> str:
    """Return why there is no estimate, if no photo with a place was found."""
    if hits:
        return "The photos that look like it have no coordinates and no place label."
    if photo_filter.is_empty:
        return "The map has no searchable photos to compare with, or this one has no structure."
    return "No photo of the map matches the filter."


def rank_live_photos(gateway: GatewayContext, query: SimilarityQuery, k: int) -> list[SearchHit]:
    """Return the first `k` live photos of the map, most similar first, without an estimate."""
    return _MapSearch(gateway, query).find(NO_FILTER, k).hits


def missing_log_odds(gateway: GatewayContext, query: SimilarityQuery) -> float | None:
    """Return `PlaceModel.missing_log_odds` of a query; None before the map is evaluated."""
    if query.generation.calibration is None:
        return None
    search = _MapSearch(gateway, query)
    found = search.find(WITH_PLACE, EVIDENCE_DEPTH)
    model, scheme = _place_model(search)
    if not found.hits:
        return None
    if not scheme.labels_are_paths and found.ranking[0].location.latitude is not None:
        return None  # it has none for coordinates: spares the second search
    neighbours = search.rank_neighbours(found.hits[0].photo_id)
    radius_m = gateway.settings.estimate_radius_m
    return model.missing_log_odds(found.ranking, neighbours, scheme, radius_m)


def _not_searchable_error(session: Session, photo: Photo, map_name: str) -> Conflict:
    """Build the 409 error: why the photo has no descriptor, and which job to poll."""
    job = session.get(Job, photo.job_id) if photo.job_id else None
    extra: dict[str, Any] = {"file_id": str(photo.id)}
    if job is None:
        return Conflict("not_searchable", "The photo has no descriptor yet.", **extra)
    status_url = job_url(job.id, map_name)
    extra |= {"job_id": str(job.id), "status_url": status_url, "state": job.state}
    if job.state == JobState.FAILED:
        reason = (job.error or {}).get("detail", "no reason is stored")
        detail = f"The photo could not be described: {reason}"
    else:
        detail = f"The photo is not searchable yet: its job is {job.state}. Poll {status_url}."
    return Conflict("not_searchable", detail, **extra)
