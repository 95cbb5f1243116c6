"""Routes of recall evaluations (`/evaluations`)."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import Field

from services.gateway.admission import ADMIT_JOB
from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import GatewayDep, MapQuery, PageQuery
from services.gateway.idempotency import IdempotentDep
from services.gateway.responses import JobAcceptedResponse
from shared.catalog.chunks import has_geotagged
from shared.catalog.generations import Evaluation, active_generation
from shared.catalog.maps import get_map
from shared.catalog.photos import PhotoRole
from shared.errors import Conflict
from shared.http.request_model import RequestModel
from shared.jobs import Job, JobKind
from shared.responses import ResponseModel
from shared.responses.maps import EvaluationResponse

router = APIRouter(tags=["evaluations"])


class EvaluationRequest(RequestModel):
    """Options of an evaluation; the defaults suit most maps."""

    sample: int = Field(
        1000, ge=1, le=1_000_000, description="maximum number of photos of the map to query with"
    )
    seed: int = Field(0, ge=0, le=2**31 - 1)


class EvaluationsResponse(ResponseModel):
    evaluations: list[EvaluationResponse]
    next_cursor: str | None


@router.post("/evaluations", status_code=202, dependencies=[WRITE, ADMIT_JOB])
def evaluate(
    gateway: GatewayDep,
    idempotent: IdempotentDep,
    query: MapQuery,
    options: EvaluationRequest | None = None,
) -> JobAcceptedResponse:
    """Evaluate the recall of the active generation.

    It is measured by leave-one-out on the map's own photos with a known place, and on its labelled
    queries. The `result` of the job contains the metrics.
    """
    params = (options or EvaluationRequest.model_validate({})).model_dump()
    with gateway.catalog.write() as session:
        map_ = get_map(session, query.map)
        generation = active_generation(session, map_.id)
        if generation is None or not has_geotagged(session, generation.id, PhotoRole.DATABASE):
            raise Conflict(
                "nothing_to_evaluate",
                "The map has no described photo with coordinates or a place. Upload photos with "
                "coordinates or places, and wait for their jobs.",
            )
        params["automatic"] = False
        job = Job(map_id=map_.id, kind=JobKind.EVALUATE, params=params)
        return idempotent.accept_job(session, job)


@router.get("/evaluations", dependencies=[READ])
def list_evaluations(gateway: GatewayDep, query: PageQuery) -> EvaluationsResponse:
    """List evaluations, newest first, including automatic ones."""
    with gateway.catalog.read() as session:
        is_of_map = Evaluation.map_id == get_map(session, query.map).id
        page, next_cursor = query.read(session, Evaluation, is_of_map)
    return EvaluationsResponse(
        evaluations=[EvaluationResponse.model_validate(row) for row in page],
        next_cursor=next_cursor,
    )
