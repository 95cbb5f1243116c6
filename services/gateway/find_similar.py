"""From a reference to a descriptor to an answer: ask the search tier, join with live photos.

Results are joined by photo id, never by position: a photo that was deleted a moment ago falls out
here, and the search is asked again for more until k live ones are found or there are no more.
"""

from __future__ import annotations

import itertools
import logging
import time
from dataclasses import dataclass
from functools import partial
from typing import Any
from uuid import UUID

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from services.gateway.choose_weights import choose_weights
from services.gateway.context import Gateway
from services.gateway.estimate import estimate, rank
from services.gateway.schemas import (
    PhotoAnswer,
    SimilarityAnswer,
    SimilarPhoto,
    job_url,
)
from services.gateway.wanted import Wanted
from shared.catalog.away import as_unavailable
from shared.catalog.chunks import descriptor_of
from shared.catalog.generations import Generation, active_generation
from shared.catalog.maps import Map, get_map
from shared.catalog.photos import Photo, get_photo, live_photos
from shared.catalog.searches import Search
from shared.catalog.vocabularies import standing_of
from shared.errors import Conflict, Gone, StorageFull
from shared.estimate.evidence import DEPTH
from shared.jobs import Job, JobState
from shared.photo_filter import EVERYTHING, PhotoFilter
from shared.search_protocol import Hit, SearchRequest, SearchResponse

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Query:
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
class Found:
    """What the search tier has found: the answer but for its photos, and their scores."""

    frame: SimilarityAnswer
    """Without photos."""
    hits: list[Hit]
    """Live, wanted, most similar first: `top_k`, or as many more as are to be reranked."""
    photos: dict[UUID, Photo]
    word_weights: tuple[float, ...]
    """By which the hits are ranked, one for each word; () for the plain ranking."""
    history: Search
    """The row to be added."""


def query_by_photo(gateway: Gateway, map_name: str, photo_id: UUID) -> Query:
    """A stored photo as a query; 404 for an unknown one, 409 while it is not searchable."""
    with gateway.catalog.read() as session:
        map_ = get_map(session, map_name)
        photo = get_photo(session, map_.id, photo_id)
        generation = active_generation(session, map_.id)
        found = descriptor_of(session, generation.id, photo.id) if generation else None
        if generation is None or found is None:
            raise _not_searchable(session, photo, map_name)
        descriptor, chunk = found
        return Query(
            map_id=map_.id,
            map_name=map_.name,
            min_version=map_.version,
            generation=generation,
            vocabulary=standing_of(session, generation),
            object_key=chunk.object_key,
            row=descriptor.row,
            photo_id=photo.id,
            filename=photo.filename,
        )


def query_by_job(gateway: Gateway, job: Job) -> Query:
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
        return Query(
            map_id=map_.id,
            map_name=map_.name,
            min_version=map_.version,
            generation=generation,
            vocabulary=standing_of(session, generation),
            object_key=result["object_key"],
            row=result["row"],
            photo_id=None,
            filename=job.params["filename"],
        )


def find_similar(gateway: Gateway, query: Query, wanted: Wanted) -> SimilarityAnswer:
    """The most similar live photos that are wanted, without the query itself, and the place that
    they point to; noted in the history."""
    found = search(gateway, query, wanted)
    try:
        with gateway.catalog.write() as session:
            session.add(found.history)
    except SQLAlchemyError as error:
        if not isinstance(as_unavailable(error), StorageFull):
            raise
        log.warning("the disk of the catalog is full: the search is not added to the history")
    return found.frame.with_photos(
        SimilarPhoto(
            similarity_score=hit.score,
            weighted_score=hit.weighted_score,
            **PhotoAnswer.fields_of(found.photos[hit.photo_id], query.map_name),
        )
        for hit in found.hits
    )


def search(gateway: Gateway, query: Query, wanted: Wanted) -> Found:
    """Ask the search tier. Whoever answers with what it has found adds the history's row."""
    started = time.perf_counter()
    weights = choose_weights(query.generation, wanted.word_weights, gateway.settings)
    shown = max(wanted.top_k, wanted.rerank or 0)
    # The estimate looks deeper than most answers, and also at what is below the least score.
    search = partial(_search_live, gateway, query, wanted, weights=weights.values)
    hits, photos, response = search(wanted.photos, max(shown, DEPTH))
    ranking = everything = rank(hits, photos)
    if not wanted.photos.is_empty:
        everything = rank(*search(EVERYTHING, DEPTH)[:2])
    found = estimate(
        weights.calibration(hits), ranking, everything, gateway.settings.estimate_radius_m
    )
    similar = hits[:shown]
    if wanted.min_score is not None and weights.values:
        # The least score is of the plain cosine: there may be more of them far down the ranking.
        similar, photos, response = search(wanted.photos, shown, min_score=wanted.min_score)
    elif wanted.min_score is not None:
        similar = [hit for hit in similar if hit.score >= wanted.min_score]
    took_ms = (time.perf_counter() - started) * 1000
    frame = SimilarityAnswer(
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
        certified_k=_certain(similar[: wanted.top_k], response),
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
        top_k=wanted.top_k,
        results=min(len(similar), wanted.top_k),
        processing_ms=took_ms,
        best_score=hits[0].score if hits else None,
        in_map=found.in_map,
    )
    weighted = any(hit.weighted_score is not None for hit in similar)
    return Found(frame, similar, photos, weights.values if weighted else (), history)


def _certain(hits: list[Hit], response: SearchResponse) -> int:
    """How many of the first of these hits the search is certain of."""
    sure = {hit.photo_id for hit in response.hits[: response.certified_k]}
    return sum(1 for _ in itertools.takewhile(lambda hit: hit.photo_id in sure, hits))


def _search_live(
    gateway: Gateway,
    query: Query,
    wanted: Wanted,
    photos: PhotoFilter,
    depth: int,
    *,
    weights: tuple[float, ...],
    min_score: float | None = None,
) -> tuple[list[Hit], dict[UUID, Photo], SearchResponse]:
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
                mode=wanted.mode,
                most_rows=wanted.most_rows,
                most_seconds=wanted.most_seconds,
            )
        )
        with gateway.catalog.read() as session:
            live = live_photos(session, [hit.photo_id for hit in response.hits])
        hits = [hit for hit in response.hits if hit.photo_id in live]
        if len(hits) >= depth or len(response.hits) < k:
            return hits[:depth], live, response
        k *= 2


def _not_searchable(session: Session, photo: Photo, map_name: str) -> Conflict:
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
