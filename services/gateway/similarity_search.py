"""From a reference to a descriptor to an answer: ask the search tier, join with live photos.

Results are joined by photo id, never by position: a photo that was deleted a moment ago falls out
here, and the search is asked again for more until k live ones are found or there are no more.

Whether an answer is ranked by word weights, and what its scores mean then.

From the ranking of a similarity search to the answer's estimate.
"""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from uuid import UUID

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from services.gateway.dependencies import GatewayContext
from services.gateway.schemas import (
    EstimateResponse,
    PhotoResponse,
    SimilarityResponse,
    SimilarPhotoResponse,
    job_url,
)
from services.gateway.search_params import SearchParams
from shared.catalog.chunks import find_descriptor
from shared.catalog.database_errors import to_unavailable
from shared.catalog.generations import Generation, active_generation
from shared.catalog.maps import Map, Search, get_map
from shared.catalog.photos import Photo, get_live_photos, get_photo
from shared.catalog.vocabularies import vocabulary_standing
from shared.config.settings import Settings
from shared.errors import Conflict, Gone, StorageFull
from shared.evaluation.calibration import Calibration
from shared.evaluation.place_evidence import (
    EVIDENCE_DEPTH,
    PhotoLocation,
    RankedPhoto,
    compute_evidence,
    estimate_location,
)
from shared.jobs import Job, JobState
from shared.search_api.photo_filter import NO_FILTER, PhotoFilter
from shared.search_api.protocol import SearchHit, SearchRequest, SearchResponse
from shared.word_weights.record import WordWeights, parse_word_weights

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RankingWeights:
    """What a search is asked with, and what that says of its answer."""

    generation: Generation
    record: WordWeights | None
    values: tuple[float, ...]
    """Empty: rank by the plain cosine."""

    def state(self, hits: Sequence[SearchHit]) -> str:
        """`applied`, `none` or `off`."""
        if self.values:
            return "applied" if self._ranked_by_weights(hits) else "none"
        return "off" if self.record and self.record.applied else "none"

    def calibration(self, hits: Sequence[SearchHit]) -> Calibration | None:
        """What the generation's evaluations have learnt of rankings like this one."""
        if self.values and self.record and self._ranked_by_weights(hits):
            return self.record.calibration
        stored = self.generation.calibration
        return Calibration.model_validate(stored) if stored else None

    def _ranked_by_weights(self, hits: Sequence[SearchHit]) -> bool:
        return not hits or hits[0].weighted_score is not None


def select_ranking_weights(
    generation: Generation, enabled: bool, settings: Settings
) -> RankingWeights:
    """Those of the generation, unless the call or the settings turn them off."""
    record = parse_word_weights(generation.word_weights)
    on = enabled and settings.word_weights
    return RankingWeights(generation, record, record.applied if record and on else ())


def locate_hits(hits: Sequence[SearchHit], photos: Mapping[UUID, Photo]) -> list[RankedPhoto]:
    """Hits with the places of their photos."""
    return [RankedPhoto(hit.ranked_by, _photo_location(photos[hit.photo_id])) for hit in hits]


def estimate_place(
    calibration: Calibration | None,
    ranking: Sequence[RankedPhoto],
    unfiltered_ranking: Sequence[RankedPhoto],
    radius_m: float,
) -> EstimateResponse:
    """Where the ranking points to, and what the generation's evaluations say of that place.

    `calibration` is what rankings of this kind, plain or by word weights, have taught.
    `unfiltered_ranking`
    is the ranking without a filter: the place has to stand up to all others, as it had to when the
    evaluations learnt what is in the map.
    """
    state = calibration.state if calibration else "uncalibrated"
    evidence = (
        compute_evidence(unfiltered_ranking, radius_m, ranking[0].location) if ranking else None
    )
    if evidence is None:
        reason = (
            "No photo of the map passes the filter."
            if not ranking
            else "The most similar photo has neither coordinates nor a place."
        )
        return EstimateResponse(calibration=state, reason=reason)
    accepted = calibration.accepts(evidence) if calibration else None
    confidence = (
        calibration.confidence.probability(evidence)
        if calibration and calibration.confidence
        else None
    )
    spot = (
        estimate_location(ranking, radius_m)
        if accepted is not False
        else PhotoLocation(None, None, None)
    )
    return EstimateResponse(
        in_map=accepted,
        latitude=spot.latitude,
        longitude=spot.longitude,
        radius_m=None if spot.latitude is None else radius_m,
        place=spot.place,
        confidence=confidence,
        calibration=state,
        reason=_estimate_reason(accepted, evidence.support, calibration),
    )


def _estimate_reason(accepted: bool | None, support: float, calibration: Calibration | None) -> str:
    if accepted is None or calibration is None or calibration.support_threshold is None:
        return (
            "Whether the place is in the map can't be told yet: first an evaluation has to see at "
            "least 20 photos with coordinates or places (POST /api/v1/evaluations)."
        )
    compared = (
        f"The first ten photos support the place by {support:.4f}; of photos that are not in the "
        f"map one in twenty reaches {calibration.support_threshold:.4f}."
    )
    return compared if accepted else f"Not in this map, as far as can be told. {compared}"


def _photo_location(photo: Photo) -> PhotoLocation:
    return PhotoLocation(photo.latitude, photo.longitude, photo.place)


@dataclass(frozen=True, slots=True)
class SimilarityQuery:
    """What is compared, with what, and what the answer says about it."""

    map_id: UUID
    map_name: str
    min_version: int
    generation: Generation
    vocabulary: str
    object_key: str
    row: int
    photo_id: UUID | None
    filename: str


@dataclass(frozen=True, slots=True)
class SimilarityResult:
    """What the search tier has found: the answer but for its photos, and their scores."""

    response_without_photos: SimilarityResponse
    """Without photos."""
    hits: list[SearchHit]
    """Live, wanted, most similar first: `top_k`, or as many more as are to be reranked."""
    photos: dict[UUID, Photo]
    word_weights: tuple[float, ...]
    """By which the hits are ranked, one for each word; () for the plain ranking."""
    history_row: Search
    """The row to be added."""


def query_from_photo(gateway: GatewayContext, map_name: str, photo_id: UUID) -> SimilarityQuery:
    """A stored photo as a query; 404 for an unknown one, 409 while it is not searchable."""
    with gateway.catalog.read() as session:
        map_ = get_map(session, map_name)
        photo = get_photo(session, map_.id, photo_id)
        generation = active_generation(session, map_.id)
        found = find_descriptor(session, generation.id, photo.id) if generation else None
        if generation is None or found is None:
            raise _not_searchable_error(session, photo, map_name)
        descriptor, chunk = found
        return SimilarityQuery(
            map_id=map_.id,
            map_name=map_.name,
            min_version=map_.version,
            generation=generation,
            vocabulary=vocabulary_standing(session, generation),
            object_key=chunk.object_key,
            row=descriptor.row,
            photo_id=photo.id,
            filename=photo.filename,
        )


def query_from_job(gateway: GatewayContext, job: Job) -> SimilarityQuery:
    """A described query photo; 410 when what it was described into has gone."""
    result: dict[str, Any] = job.result or {}
    with gateway.catalog.read() as session:
        map_ = session.get_one(Map, job.map_id)
        generation = session.get(Generation, UUID(result["generation_id"]))
        if generation is None:
            raise Gone(
                "query_expired",
                "The query's generation is gone. Ask with the photo again.",
            )
        return SimilarityQuery(
            map_id=map_.id,
            map_name=map_.name,
            min_version=map_.version,
            generation=generation,
            vocabulary=vocabulary_standing(session, generation),
            object_key=result["object_key"],
            row=result["row"],
            photo_id=None,
            filename=job.params["filename"],
        )


def find_similar(
    gateway: GatewayContext, query: SimilarityQuery, search_params: SearchParams
) -> SimilarityResponse:
    """The most similar live photos that are wanted, without the query itself, and the place that
    they point to; noted in the history."""
    found = run_similarity_search(gateway, query, search_params)
    try:
        with gateway.catalog.write() as session:
            session.add(found.history_row)
    except SQLAlchemyError as error:
        if not isinstance(to_unavailable(error), StorageFull):
            raise
        log.warning("the disk of the catalog is full: the search is not added to the history")
    return found.response_without_photos.with_photos(
        SimilarPhotoResponse(
            similarity_score=hit.score,
            weighted_score=hit.weighted_score,
            **PhotoResponse.fields_of(found.photos[hit.photo_id], query.map_name),
        )
        for hit in found.hits
    )


def run_similarity_search(
    gateway: GatewayContext, query: SimilarityQuery, search_params: SearchParams
) -> SimilarityResult:
    """Ask the search tier. Whoever answers with what it has found adds the history's row."""
    started = time.perf_counter()
    weights = select_ranking_weights(query.generation, search_params.word_weights, gateway.settings)
    shown = max(search_params.top_k, search_params.rerank or 0)
    # The estimate looks deeper than most answers, and also at what is below the least score.
    run_similarity_search = partial(
        _search_live_photos, gateway, query, search_params, weights=weights.values
    )
    hits, photos, response = run_similarity_search(search_params.photos, max(shown, EVIDENCE_DEPTH))
    ranking = everything = locate_hits(hits, photos)
    if not search_params.photos.is_empty:
        everything = locate_hits(*run_similarity_search(NO_FILTER, EVIDENCE_DEPTH)[:2])
    found = estimate_place(
        weights.calibration(hits), ranking, everything, gateway.settings.estimate_radius_m
    )
    similar = hits[:shown]
    if search_params.min_score is not None and weights.values:
        # The least score is of the plain cosine: there may be more of them far down the ranking.
        similar, photos, response = run_similarity_search(
            search_params.photos, shown, min_score=search_params.min_score
        )
    elif search_params.min_score is not None:
        similar = [hit for hit in similar if hit.score >= search_params.min_score]
    took_ms = (time.perf_counter() - started) * 1000
    frame = SimilarityResponse(
        query_file_id=query.photo_id,
        query_filename=query.filename,
        processing_time_ms=took_ms,
        total_similar=0,
        similar_images=[],
        estimate=found,
        vocabulary=query.vocabulary,
        word_weights=weights.state(hits),
        generation_id=query.generation.id,
        certificate=response.certificate,
        certified_k=_count_certified(similar[: search_params.top_k], response),
        max_z=response.max_z,
        rows_scanned=response.rows_scanned,
        rows_reranked=response.rows_reranked,
        snapshot_version=response.snapshot_version,
        degraded=bool(response.missing),
        missing=list(response.missing),
    )
    history = Search(
        map_id=query.map_id,
        generation_id=query.generation.id,
        query_photo_id=query.photo_id,
        query_filename=query.filename,
        top_k=search_params.top_k,
        results=min(len(similar), search_params.top_k),
        processing_ms=took_ms,
        best_score=hits[0].score if hits else None,
        in_map=found.in_map,
    )
    weighted = any(hit.weighted_score is not None for hit in similar)
    return SimilarityResult(frame, similar, photos, weights.values if weighted else (), history)


def _count_certified(hits: list[SearchHit], response: SearchResponse) -> int:
    """How many of the first of these hits the search is certain of."""
    sure = {hit.photo_id for hit in response.hits[: response.certified_k]}
    return sum(1 for _ in itertools.takewhile(lambda hit: hit.photo_id in sure, hits))


def _search_live_photos(
    gateway: GatewayContext,
    query: SimilarityQuery,
    search_params: SearchParams,
    photos: PhotoFilter,
    depth: int,
    *,
    weights: tuple[float, ...],
    min_score: float | None = None,
) -> tuple[list[SearchHit], dict[UUID, Photo], SearchResponse]:
    """The first `depth` live photos, fewer when there are no more."""
    k = depth
    while True:
        response = gateway.search.search(
            SearchRequest(
                map_id=query.map_id,
                generation_id=query.generation.id,
                object_key=query.object_key,
                row=query.row,
                min_version=query.min_version,
                k=k,
                photos=photos,
                min_score=min_score,
                exclude=(query.photo_id,) if query.photo_id else (),
                word_weights=weights,
                mode=search_params.mode,
                most_rows=search_params.most_rows,
                most_seconds=search_params.most_seconds,
            )
        )
        with gateway.catalog.read() as session:
            live = get_live_photos(session, [hit.photo_id for hit in response.hits])
        hits = [hit for hit in response.hits if hit.photo_id in live]
        if len(hits) >= depth or len(response.hits) < k:
            return hits[:depth], live, response
        k *= 2


def _not_searchable_error(session: Session, photo: Photo, map_name: str) -> Conflict:
    """Why the photo can't be asked with, and what to wait for."""
    job = session.get(Job, photo.job_id) if photo.job_id else None
    extra: dict[str, Any] = {"file_id": str(photo.id)}
    if job is None:
        return Conflict("not_searchable", "The photo is not described yet.", **extra)
    status_url = job_url(job.id, map_name)
    extra |= {"job_id": str(job.id), "status_url": status_url, "state": job.state}
    if job.state == JobState.FAILED:
        reason = (job.error or {}).get("detail", "no reason is stored")
        detail = f"The photo could not be described: {reason}"
    elif job.waiting_for:
        detail = f"The photo is not searchable yet: its job waits for a {job.waiting_for}."
    else:
        detail = f"The photo is not searchable yet: its job is {job.state}. Poll {status_url}."
    return Conflict("not_searchable", detail, **extra)
