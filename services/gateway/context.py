"""What every route can reach, and the parameters that every call understands."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Annotated
from uuid import UUID

from fastapi import Depends, Query, Request
from prometheus_client import CollectorRegistry
from pydantic import BeforeValidator

from services.gateway.job_watch import JobNotifier
from services.gateway.keys import Authenticator
from services.http_connections import ConnectionLimits, Connections
from shared.catalog.maps import DEFAULT_MAP
from shared.catalog.session import Catalog
from shared.errors import NotFound, invalid_field_error
from shared.jobs import Wakeups
from shared.objects import ObjectStore
from shared.search_protocol import SearchBackend
from shared.settings import Settings

API_PREFIX = "/api/v1"
NO_NUL_PATTERN = r"^[^\x00]*$"  # PostgreSQL has no text with a NUL


@dataclass(frozen=True, slots=True)
class GatewayContext:
    """The ports that the gateway speaks to."""

    catalog: Catalog
    store: ObjectStore
    hints: Wakeups
    search: SearchBackend
    settings: Settings
    authenticator: Authenticator
    registry: CollectorRegistry = field(default_factory=CollectorRegistry)
    """Of the process's figures: in the embedded Placewise, of all of its parts."""
    started_monotonic: float = field(default_factory=time.monotonic)
    job_notifier: JobNotifier = field(init=False)
    connections: Connections = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "job_watch", JobNotifier(self.catalog))
        object.__setattr__(self, "connections", Connections(ConnectionLimits.of(self.settings)))


def get_gateway_context(request: Request) -> GatewayContext:
    gateway: GatewayContext = request.app.state.gateway
    return gateway


def _uuid_or_not_found(noun: str):  # type: ignore[no-untyped-def]
    def parse(value: object) -> UUID:
        try:
            return UUID(str(value))
        except ValueError:
            # What is no id can't be the id of anything: 404, like any other unknown one.
            raise NotFound(f"{noun}_not_found", f"There is no {noun} {value!r}.") from None

    return BeforeValidator(parse)


def parse_cursor(cursor: str | None) -> UUID | None:
    """The id that a page ended with; 422 for a cursor that no call has given."""
    try:
        return UUID(cursor) if cursor else None
    except ValueError:
        raise invalid_field_error("cursor", "is not one that this call has given") from None


GatewayDep = Annotated[GatewayContext, Depends(get_gateway_context)]
MapName = Annotated[
    str,
    Query(
        alias="map",
        description="The map that is meant.",
        min_length=1,
        max_length=100,
        pattern=NO_NUL_PATTERN,
    ),
]
FileId = Annotated[UUID, _uuid_or_not_found("photo")]
UploadId = Annotated[UUID, _uuid_or_not_found("upload")]
JobId = Annotated[UUID, _uuid_or_not_found("job")]
GenerationId = Annotated[UUID, _uuid_or_not_found("generation")]
KeyId = Annotated[UUID, _uuid_or_not_found("key")]
WebhookId = Annotated[UUID, _uuid_or_not_found("webhook")]

__all__ = [
    "API_PREFIX",
    "DEFAULT_MAP",
    "NO_NUL_PATTERN",
    "FileId",
    "GatewayContext",
    "GatewayDep",
    "GenerationId",
    "JobId",
    "KeyId",
    "MapName",
    "UploadId",
    "WebhookId",
    "parse_cursor",
]
