"""`/evaluations`: how often the right place comes first, measured on a live map."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from services.gateway.context import DEFAULT_MAP, GatewayDep, MapName, parse_cursor
from services.gateway.key_check import READ, WRITE
from services.gateway.once import IdempotentDep, IdempotentRequest
from services.gateway.room import ADMIT_JOB
from services.gateway.schemas import JobAcceptedResponse, ResponseModel, accept_job
from shared.catalog.chunks import has_geotagged
from shared.catalog.evaluations import Evaluation, list_evaluations
from shared.catalog.generations import Generation, active_generation
from shared.catalog.maps import get_map
from shared.catalog.photos import PhotoRole
from shared.errors import Conflict
from shared.ids import new_id
from shared.jobs import Job, JobKind, Priority

router = APIRouter(tags=["evaluations"])


class EvaluationRequest(BaseModel):
    """What to measure; {} is a good choice."""

    model_config = ConfigDict(extra="forbid")

    sample: int = Field(
        1000, ge=1, le=1_000_000, description="photos of the map to ask with, at most"
    )
    seed: int = Field(0, ge=0, le=2**31 - 1)


class EvaluationResponse(ResponseModel):
    evaluation_id: UUID
    generation_id: UUID
    automatic: bool = Field(description="made because the map had changed")
    searchable: int = Field(description="photos that could be found then")
    figures: dict[str, Any] = Field(
        description="`leave_one_out`: the map's own photos asked, themselves left out; "
        "`labelled_queries`: photos of role `query`; R@k is the share, of those that the map has "
        "another photo of, with a right one among the first k; `with_word_weights`: the same, "
        "ranked by the generation's word weights, null where it has none"
    )
    evaluated_at: datetime

    @classmethod
    def of(cls, evaluation: Evaluation) -> EvaluationResponse:
        return cls(
            evaluation_id=evaluation.id,
            generation_id=evaluation.generation_id,
            automatic=evaluation.automatic,
            searchable=evaluation.searchable,
            figures=evaluation.figures,
            evaluated_at=evaluation.evaluated_at,
        )


class EvaluationsResponse(ResponseModel):
    evaluations: list[EvaluationResponse]
    next_cursor: str | None


@router.post(
    "/evaluations",
    operation_id="evaluate",
    status_code=202,
    response_model=JobAcceptedResponse,
    dependencies=[WRITE, ADMIT_JOB],
)
def start_evaluation(
    gateway: GatewayDep,
    response: Response,
    idempotent: IdempotentDep,
    options: EvaluationRequest | None = None,
    map_name: MapName = DEFAULT_MAP,
) -> JobAcceptedResponse:
    """Measure the active generation: leave-one-out on the map's own photos whose place is known,
    and recall on its labelled queries. The job's `result` has the figures."""
    params = (options or EvaluationRequest.model_validate({})).model_dump()
    with gateway.catalog.write() as session:
        map_ = get_map(session, map_name)
        generation = active_generation(session, map_.id)
        job = queue_evaluation_job(
            session,
            idempotent,
            map_.id,
            generation,
            JobKind.EVALUATE,
            {**params, "automatic": False},
        )
    return accept_job(response, job, map_name)


@router.get(
    "/evaluations",
    operation_id="list_evaluations",
    response_model=EvaluationsResponse,
    dependencies=[READ],
)
def read_evaluations(
    gateway: GatewayDep,
    limit: Annotated[int, Query(ge=1, le=1000)] = 50,
    cursor: Annotated[str | None, Query()] = None,
    map_name: MapName = DEFAULT_MAP,
) -> EvaluationsResponse:
    """Newest first, those made by themselves as well: before and after a vocabulary, in numbers."""
    before = parse_cursor(cursor)
    with gateway.catalog.read() as session:
        found = list_evaluations(session, get_map(session, map_name).id, limit + 1, before)
    page = found[:limit]
    return EvaluationsResponse(
        evaluations=[EvaluationResponse.of(evaluation) for evaluation in page],
        next_cursor=str(page[-1].id) if len(found) > limit else None,
    )


def queue_evaluation_job(
    session: Session,
    idempotent: IdempotentRequest,
    map_id: UUID,
    generation: Generation | None,
    kind: JobKind,
    params: dict[str, Any],
) -> Job:
    """A job that asks the generation with the map's own photos; Conflict (`nothing_to_evaluate`)
    where none of them has a place."""
    if generation is None or not has_geotagged(session, generation.id, PhotoRole.DATABASE):
        raise Conflict(
            "nothing_to_evaluate",
            "The map has no described photo with coordinates or a place. Upload some, and wait "
            "for their jobs.",
        )
    job = Job(id=new_id(), map_id=map_id, kind=kind, priority=Priority.EVALUATION, params=params)
    session.add(job)
    session.flush()
    idempotent.store_job_response(session, job)
    return job
