"""Answers whose first photos an extractor has looked at closely: `rerank=N` and `explain=true`.

The search tier is asked as always. What it finds becomes a compare job of the highest priority,
with the rest of the answer in its params; the call waits a while for it. The job's result is joined
with live photos anew, so that what was deleted meanwhile is in no answer.
"""

from __future__ import annotations

from uuid import UUID

from pydantic import BaseModel, ConfigDict
from sqlalchemy.orm import Session

from services.gateway.context import Gateway
from services.gateway.find_similar import Query, search
from services.gateway.once import Once
from services.gateway.schemas import (
    ExplanationAnswer,
    PhotoAnswer,
    SimilarityAnswer,
    SimilarPhoto,
)
from services.gateway.wanted import Wanted
from shared.catalog.generations import active_generation
from shared.catalog.maps import get_map
from shared.catalog.photos import live_photos
from shared.catalog.searches import Search
from shared.comparison import (
    Candidate,
    Compared,
    ComparedCandidate,
    Comparison,
    check_can_explain,
    check_can_rerank,
    query_expired,
)
from shared.errors import NotFound
from shared.ids import new_id
from shared.jobs import Job, JobKind, Priority
from shared.jobs.hints import Lane
from shared.objects.keys import comparison_key

OF_QUERY = "compare_job_id"
"""In the params of a describe job: the job that compares its photo."""


class Params(BaseModel):
    """What a compare job carries: what is asked of the extractor, and the rest of the answer."""

    model_config = ConfigDict(frozen=True)

    request: Comparison
    top_k: int
    frame: SimilarityAnswer


def check_closely(gateway: Gateway, map_name: str, wanted: Wanted) -> None:
    """Unprocessable (`not_rerankable`, `not_explainable`) for what the map's extractor can't do."""
    if not wanted.closely:
        return
    with gateway.catalog.read() as session:
        map_ = get_map(session, map_name)
        generation = active_generation(session, map_.id)
    recipe = gateway.settings.recipe(generation.extractor if generation else map_.extractor)
    if wanted.rerank is not None:
        check_can_rerank(recipe)
    if wanted.explain:
        check_can_explain(recipe, generation.spec if generation else None)


def compare_stored(gateway: Gateway, query: Query, wanted: Wanted, once: Once) -> Job:
    """Search for a stored photo, and queue the comparison."""
    job, history = _make_job(gateway, query, wanted, None)
    with gateway.catalog.write() as session:
        session.add_all([job, history])
        session.flush()
        once.keep_job(session, job)
    gateway.hints.send(Lane.QUERY)
    return job


def compare_described(gateway: Gateway, described: Job, query: Query, wanted: Wanted) -> Job:
    """The one comparison of a described query photo: the one that there is, or else a new one."""
    with gateway.catalog.read() as session:
        found = _comparison_of(session, described)
    if found is not None:
        return found
    job, history = _make_job(gateway, query, wanted, described.id)
    with gateway.catalog.write() as session:
        current = session.get(Job, described.id, with_for_update=True, populate_existing=True)
        if current is None:
            raise query_expired()
        found = _comparison_of(session, current)
        if found is not None:  # another call was first
            return found
        current.params = {**current.params, OF_QUERY: str(job.id)}
        session.add_all([job, history])
    gateway.hints.send(Lane.QUERY)
    return job


def compared_answer(gateway: Gateway, job: Job, map_name: str) -> SimilarityAnswer:
    """The answer of a compare job that has succeeded; Gone (`query_expired`) once it has gone."""
    params = Params.model_validate(job.params)
    try:
        data = gateway.store.get(comparison_key(job.id))
    except NotFound:
        raise query_expired() from None
    candidates = Compared.model_validate_json(data).candidates
    scores = {one.photo_id: one for one in params.request.candidates}
    with gateway.catalog.read() as session:
        photos = live_photos(session, scores)
    live = [one for one in candidates if one.photo_id in photos]
    assert job.finished_at is not None
    took_ms = (job.finished_at - job.created_at).total_seconds() * 1000
    return params.frame.model_copy(
        update={"processing_time_ms": params.frame.processing_time_ms + took_ms}
    ).with_photos(
        SimilarPhoto(
            similarity_score=scores[one.photo_id].score,
            weighted_score=scores[one.photo_id].weighted_score,
            rerank_score=one.rerank_score,
            explanation=_explanation(one),
            **PhotoAnswer.fields_of(photos[one.photo_id], map_name),
        )
        for one in live[: params.top_k]
    )


def _comparison_of(session: Session, described: Job) -> Job | None:
    known = described.params.get(OF_QUERY)
    return session.get(Job, UUID(known)) if known else None


def _make_job(
    gateway: Gateway, query: Query, wanted: Wanted, described: UUID | None
) -> tuple[Job, Search]:
    """A job to be queued, and the history's row: of each question one, however often its answer is
    fetched."""
    found = search(gateway, query, wanted)
    params = Params(
        request=Comparison(
            query_photo_id=query.photo_id,
            query_job_id=described,
            candidates=tuple(
                Candidate(photo_id=hit.photo_id, score=hit.score, weighted_score=hit.weighted_score)
                for hit in found.hits
            ),
            rerank=wanted.rerank or 0,
            explain=wanted.top_k if wanted.explain else 0,
            word_weights=found.word_weights,
        ),
        top_k=wanted.top_k,
        frame=found.frame,
    )
    job = Job(
        id=new_id(),
        map_id=query.map_id,
        kind=JobKind.COMPARE,
        priority=Priority.QUERY,
        generation_id=query.generation.id,
        params=params.model_dump(mode="json"),
    )
    return job, found.history


def _explanation(one: ComparedCandidate) -> ExplanationAnswer | None:
    return (
        ExplanationAnswer.model_validate(one.explanation.model_dump()) if one.explanation else None
    )
