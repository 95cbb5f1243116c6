"""`/generations/{id}/word-weights`: which words of the vocabulary tell the map's places apart."""

from __future__ import annotations

from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Response
from fastapi import Path as PathParameter
from pydantic import BaseModel, ConfigDict, Field

from services.gateway.context import DEFAULT_MAP, GatewayDep, GenerationId, MapName
from services.gateway.evaluations import queue_evaluation_job
from services.gateway.key_check import READ, WRITE
from services.gateway.once import IdempotentDep
from services.gateway.room import ADMIT_JOB
from services.gateway.schemas import JobAcceptedResponse, ResponseModel, accept_job
from shared.catalog.generations import GenerationState, get_generation
from shared.catalog.maps import get_map
from shared.catalog.vocabularies import word_weights_unavailable_reason
from shared.errors import Conflict, NotFound
from shared.jobs import JobKind
from shared.word_weights.record import HeldOut, Outcome, WordWeights, parse_word_weights

router = APIRouter(tags=["evaluations"])


class WordWeightsRequest(BaseModel):
    """How to learn them; {} is a good choice."""

    model_config = ConfigDict(extra="forbid")

    sample: int = Field(
        1000, ge=1, le=1_000_000, description="photos of the map to try them on, at most"
    )
    seed: int = Field(0, ge=0, le=2**31 - 1, description="decides pairs, halves and sample")


class WordWeightsResponse(ResponseModel):
    generation_id: UUID
    outcome: Outcome = Field(
        description="`kept`: searches rank by them; `not kept`: recall did not rise by more than "
        "chance; `not enough pairs`"
    )
    reason: str
    taught_by: str = Field(description="`coordinates` or `places`")
    near_pairs: int = Field(description="pairs of photos of one place that have taught")
    far_pairs: int = Field(description="pairs of photos of two places that have taught")
    seed: int
    searchable: int = Field(description="photos that could be found then")
    held_out: HeldOut | None = Field(
        description="photos asked with what the half of the map without them has taught: recall "
        "`without` weights and `weighted`"
    )
    weights: list[float] = Field(description="one for each word of the vocabulary, in its order")

    @classmethod
    def of(cls, generation_id: UUID, record: WordWeights) -> WordWeightsResponse:
        said: dict[str, Any] = record.model_dump(exclude={"calibration"})
        return cls(generation_id=generation_id, **said)


GenerationIdPath = Annotated[GenerationId, PathParameter(description="of the map")]


@router.post(
    "/generations/{generation_id}/word-weights",
    operation_id="learn_word_weights",
    status_code=202,
    response_model=JobAcceptedResponse,
    dependencies=[WRITE, ADMIT_JOB],
)
def start_word_weights_fit(
    gateway: GatewayDep,
    response: Response,
    idempotent: IdempotentDep,
    generation_id: GenerationIdPath,
    options: WordWeightsRequest | None = None,
    map_name: MapName = DEFAULT_MAP,
) -> JobAcceptedResponse:
    """Learn from the map's own places which words of its vocabulary to trust; keep the weights
    where they raise recall on photos that have not taught them."""
    params = (options or WordWeightsRequest.model_validate({})).model_dump()
    with gateway.catalog.write() as session:
        map_ = get_map(session, map_name)
        generation = get_generation(session, map_.id, generation_id)
        if generation.state != GenerationState.ACTIVE:
            raise Conflict(
                "generation_not_active",
                f"The generation is {generation.state}: no search asks it, so nothing can be "
                "tried. GET /api/v1/generations names the active one.",
            )
        if reason := word_weights_unavailable_reason(session, generation):
            raise Conflict("no_word_weights", f"This generation gets no word weights: {reason}.")
        params["generation_id"] = str(generation.id)
        job = queue_evaluation_job(
            session, idempotent, map_.id, generation, JobKind.WORD_WEIGHTS, params
        )
    return accept_job(response, job, map_name)


@router.get(
    "/generations/{generation_id}/word-weights",
    operation_id="read_word_weights",
    response_model=WordWeightsResponse,
    dependencies=[READ],
)
def read_word_weights(
    gateway: GatewayDep, generation_id: GenerationIdPath, map_name: MapName = DEFAULT_MAP
) -> WordWeightsResponse:
    """What the map's places have taught; 404 before that."""
    with gateway.catalog.read() as session:
        generation = get_generation(session, get_map(session, map_name).id, generation_id)
    record = parse_word_weights(generation.word_weights)
    if record is None:
        raise NotFound(
            "word_weights_not_found",
            f"The generation {generation_id} has learnt no word weights. Have them learnt: POST "
            f"/api/v1/generations/{generation_id}/word-weights.",
        )
    return WordWeightsResponse.of(generation_id, record)
