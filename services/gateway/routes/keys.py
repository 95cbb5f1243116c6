"""Routes of API keys: list, create and revoke. They need the scope `admin`."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter
from pydantic import Field

from services.gateway.authentication import ADMIN
from services.gateway.dependencies import NO_NUL_PATTERN, NO_PARAMETERS, GatewayDep, KeyId
from shared.catalog.api_keys import ApiKey, KeyLimits, create_api_key, revoke_api_key
from shared.catalog.database.base import list_newest
from shared.catalog.maps import MAP_NAME_PATTERN
from shared.http.request_model import RequestModel
from shared.responses.maps import CreatedKeyResponse, KeyResponse
from shared.security.api_keys import Scope

router = APIRouter(tags=["administration"], dependencies=[NO_PARAMETERS])

DAY_SECONDS = 86_400
MAX_KEY_DAYS = 36_500

MapName = Annotated[str, Field(json_schema_extra={"pattern": MAP_NAME_PATTERN})]
KeyLimit = Annotated[int | None, Field(ge=1, le=2**53)]


class CreateKeyRequest(RequestModel):
    """The key to create. Omitted limits are those of the server's settings."""

    name: str = Field(min_length=1, max_length=200, pattern=NO_NUL_PATTERN)
    scopes: list[Scope] = Field(min_length=1, max_length=len(Scope))
    maps: list[MapName] | None = Field(
        None,
        min_length=1,
        max_length=100,
        description="names of the only maps that the key may use, which need not exist yet; null: "
        "all maps. Not with the scope admin",
    )
    days: float | None = Field(
        None,
        gt=0,
        le=MAX_KEY_DAYS,
        allow_inf_nan=False,
        description="days until it expires; null: never",
    )
    requests_per_minute: Annotated[int | None, Field(ge=1, le=10**9)] = None
    max_photos: KeyLimit = None


@router.get("/keys", dependencies=[ADMIN])
def list_keys(gateway: GatewayDep) -> list[KeyResponse]:
    """List all keys, newest first, including revoked ones. The secrets are not stored."""
    with gateway.catalog.read() as session:
        return [KeyResponse.model_validate(key) for key in list_newest(session, ApiKey)]


@router.post("/keys", status_code=201, dependencies=[ADMIN])
def create_key(gateway: GatewayDep, body: CreateKeyRequest) -> CreatedKeyResponse:
    """Create a key. The secret is shown only in this response and is not stored.

    Therefore this endpoint does not support `Idempotency-Key`: if the response is lost, revoke the
    key and create another one.
    """
    limits = KeyLimits(body.requests_per_minute, body.max_photos)
    life_seconds = None if body.days is None else body.days * DAY_SECONDS
    with gateway.catalog.write() as session:
        api_key, secret = create_api_key(
            session,
            body.name,
            set(body.scopes),
            life_seconds=life_seconds,
            limits=limits,
            maps=body.maps,
        )
        return CreatedKeyResponse.of_row(api_key, key=secret)


@router.delete("/keys/{key_id}", dependencies=[ADMIN])
def revoke_key(gateway: GatewayDep, key_id: KeyId) -> KeyResponse:
    """Revoke a key. All gateways refuse it at once; it stays in the list."""
    with gateway.catalog.write() as session:
        return KeyResponse.model_validate(revoke_api_key(session, key_id))
