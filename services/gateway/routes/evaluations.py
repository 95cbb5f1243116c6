"""Routes of recall evaluations (`/evaluations`) and of word weights.

`/generations/{generation_id}/word-weights` fits weights for the words of the vocabulary by how well
they distinguish the places of the map.
"""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter
from fastapi import Path as PathParameter
from pydantic import Field
from sqlalchemy.orm import Session

from services.gateway.admission import ADMIT_JOB
from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import GatewayDep, GenerationId, MapQuery, PageQuery
from services.gateway.idempotency import IdempotentDep
from services.gateway.json_bodies import JsonRoute
from services.gateway.schemas import JobAcceptedResponse, ResponseModel
from shared.catalog.chunks import has_geotagged
from shared.catalog.generations import (
    Generation,
    GenerationState,
    active_generation,
    get_generation,
    list_evaluations,
)
from shared.catalog.maps import get_map
from shared.catalog.photos import PhotoRole
from shared.catalog.vocabularies import word_weights_unavailable_reason
from shared.errors import Conflict, NotFound
from shared.http.request_model import RequestModel
from shared.ids import new_id
from shared.jobs import Job, JobKind, Priority
from shared.word_weights.record import HeldOut, Outcome, WordWeights, parse_word_weights

router = APIRouter(tags=["evaluations"], route_class=JsonRoute)


class EvaluationRequest(RequestModel):
    """Options of an evaluation; the defaults suit most maps."""

    sample: int = Field(
        1000, ge=1, le=1_000_000, description="maximum number of photos of the map to query with"
    )
    seed: int = Field(0, ge=0, le=2**31 - 1)


class EvaluationResponse(ResponseModel):
    evaluation_id: UUID = Field(validation_alias="id")
    generation_id: UUID
    automatic: bool = Field(description="started automatically after a change of the map")
    searchable: int = Field(description="number of searchable photos at that time")
    figures: dict[str, Any] = Field(
        description="`leave_one_out`: queries with the map's own photos, each without itself, "
        "which flatters; `leave_one_out_without_sequence`: each without the photos that were taken "
        "within 60 s of it, or whose names differ by one number only, at most 60 apart; "
        "`labelled_queries`: queries with the photos of role `query`; R@k is the share of queries "
        "with a right photo among the first k, of those that have a right photo in the map; "
        "`with_word_weights`: the same, ranked by the word weights; null if there are none"
    )
    evaluated_at: datetime


class EvaluationsResponse(ResponseModel):
    evaluations: list[EvaluationResponse]
    next_cursor: str | None


@router.post(
    "/evaluations", operation_id="evaluate", status_code=202, dependencies=[WRITE, ADMIT_JOB]
)
def start_evaluation(
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
        params["automatic"] = False
        job = _new_evaluation_job(session, map_.id, generation, JobKind.EVALUATE, params)
        return idempotent.accept_job(session, job)


@router.get("/evaluations", operation_id="list_evaluations", dependencies=[READ])
def read_evaluations(gateway: GatewayDep, query: PageQuery) -> EvaluationsResponse:
    """List evaluations, newest first, including automatic ones."""
    before = query.before
    with gateway.catalog.read() as session:
        map_id = get_map(session, query.map).id
        rows = list_evaluations(session, map_id, query.limit + 1, before)
    page, next_cursor = query.split(rows)
    return EvaluationsResponse(
        evaluations=[EvaluationResponse.model_validate(row) for row in page],
        next_cursor=next_cursor,
    )


def _new_evaluation_job(
    session: Session,
    map_id: UUID,
    generation: Generation | None,
    kind: JobKind,
    params: dict[str, Any],
) -> Job:
    """Create a job that queries the generation with the map's own photos."""
    if generation is None or not has_geotagged(session, generation.id, PhotoRole.DATABASE):
        raise Conflict(
            "nothing_to_evaluate",
            "The map has no described photo with coordinates or a place. Upload photos with "
            "coordinates or places, and wait for their jobs.",
        )
    return Job(id=new_id(), map_id=map_id, kind=kind, priority=Priority.EVALUATION, params=params)


class WordWeightsRequest(RequestModel):
    """Options of the fit; the defaults suit most maps."""

    sample: int = Field(
        1000, ge=1, le=1_000_000, description="maximum number of photos to validate on"
    )
    seed: int = Field(
        0, ge=0, le=2**31 - 1, description="seed of the pairs, the halves and the sample"
    )


class WordWeightsResponse(ResponseModel):
    generation_id: UUID
    outcome: Outcome = Field(
        description="`kept`: searches rank by the weights; `not kept`: recall did not improve "
        "significantly; `not enough pairs`"
    )
    reason: str
    taught_by: str = Field(description="`coordinates` or `places`")
    near_pairs: int = Field(description="training pairs of photos of the same place")
    far_pairs: int = Field(description="training pairs of photos of different places")
    seed: int
    searchable: int = Field(description="number of searchable photos at that time")
    held_out: HeldOut | None = Field(
        description="cross-validation in two halves of the map: recall `without` weights and "
        "`weighted`, on photos that the weights were not fitted on"
    )
    weights: list[float] = Field(description="one per word of the vocabulary, in its order")

    @classmethod
    def of(cls, generation_id: UUID, record: WordWeights) -> WordWeightsResponse:
        fields: dict[str, Any] = record.model_dump(exclude={"calibration"})
        return cls(generation_id=generation_id, **fields)


GenerationIdPath = Annotated[GenerationId, PathParameter(description="a generation of the map")]


@router.post(
    "/generations/{generation_id}/word-weights",
    operation_id="learn_word_weights",
    status_code=202,
    dependencies=[WRITE, ADMIT_JOB],
)
def start_word_weights_fit(
    gateway: GatewayDep,
    idempotent: IdempotentDep,
    generation_id: GenerationIdPath,
    query: MapQuery,
    options: WordWeightsRequest | None = None,
) -> JobAcceptedResponse:
    """Fit word weights on the map's own places.

    The weights are used only if they improve recall on photos that they were not fitted on.
    """
    params = (options or WordWeightsRequest.model_validate({})).model_dump()
    with gateway.catalog.write() as session:
        map_ = get_map(session, query.map)
        generation = get_generation(session, map_.id, generation_id)
        if generation.state != GenerationState.ACTIVE:
            raise Conflict(
                "generation_not_active",
                f"The generation is {generation.state}, so it can't be searched and weights can't "
                "be validated. Use the active one (GET /api/v1/generations).",
            )
        if reason := word_weights_unavailable_reason(session, generation):
            raise Conflict(
                "no_word_weights", f"Word weights can't be fitted for this generation: {reason}."
            )
        params["generation_id"] = str(generation.id)
        job = _new_evaluation_job(session, map_.id, generation, JobKind.WORD_WEIGHTS, params)
        return idempotent.accept_job(session, job)


@router.get(
    "/generations/{generation_id}/word-weights",
    operation_id="read_word_weights",
    dependencies=[READ],
)
def read_word_weights(
    gateway: GatewayDep, generation_id: GenerationIdPath, query: MapQuery
) -> WordWeightsResponse:
    """Get the fitted word weights; 404 if none were fitted."""
    with gateway.catalog.read() as session:
        generation = get_generation(session, get_map(session, query.map).id, generation_id)
    record = parse_word_weights(generation.word_weights)
    if record is None:
        raise NotFound(
            "word_weights_not_found",
            f"The generation {generation_id} has no word weights. Fit them: POST "
            f"/api/v1/generations/{generation_id}/word-weights.",
        )
    return WordWeightsResponse.of(generation_id, record)
