"""What every route can reach, and the parameters that every call understands."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Annotated
from uuid import UUID

from fastapi import Depends, Query, Request
from prometheus_client import CollectorRegistry
from pydantic import BeforeValidator

from services.gateway.job_watch import JobWatch
from services.gateway.keys import Keys
from services.http_connections import ConnectionLimits, Connections
from shared.catalog.maps import DEFAULT_MAP
from shared.catalog.session import Catalog
from shared.errors import NotFound, invalid_field
from shared.jobs import Hints
from shared.objects import ObjectStore
from shared.search_protocol import SearchPort
from shared.settings import Settings

API = "/api/v1"
NO_NUL = r"^[^\x00]*$"  # PostgreSQL has no text with a NUL


@dataclass(frozen=True, slots=True)
class Gateway:
    """The ports that the gateway speaks to."""

    catalog: Catalog
    store: ObjectStore
    hints: Hints
    search: SearchPort
    settings: Settings
    keys: Keys
    registry: CollectorRegistry = field(default_factory=CollectorRegistry)
    """Of the process's figures: in the embedded Placewise, of all of its parts."""
    started: float = field(default_factory=time.monotonic)
    job_watch: JobWatch = field(init=False)
    connections: Connections = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "job_watch", JobWatch(self.catalog))
        object.__setattr__(self, "connections", Connections(ConnectionLimits.of(self.settings)))


def get_gateway(request: Request) -> Gateway:
    gateway: Gateway = request.app.state.gateway
    return gateway


def _known_shape(noun: str):  # type: ignore[no-untyped-def]
    def parse(value: object) -> UUID:
        try:
            return UUID(str(value))
        except ValueError:
            # What is no id can't be the id of anything: 404, like any other unknown one.
            raise NotFound(f"{noun}_not_found", f"There is no {noun} {value!r}.") from None

    return BeforeValidator(parse)


def read_cursor(cursor: str | None) -> UUID | None:
    """The id that a page ended with; 422 for a cursor that no call has given."""
    try:
        return UUID(cursor) if cursor else None
    except ValueError:
        raise invalid_field("cursor", "is not one that this call has given") from None


GatewayDep = Annotated[Gateway, Depends(get_gateway)]
MapName = Annotated[
    str,
    Query(
        alias="map",
        description="The map that is meant.",
        min_length=1,
        max_length=100,
        pattern=NO_NUL,
    ),
]
FileId = Annotated[UUID, _known_shape("photo")]
UploadId = Annotated[UUID, _known_shape("upload")]
JobId = Annotated[UUID, _known_shape("job")]
GenerationId = Annotated[UUID, _known_shape("generation")]
KeyId = Annotated[UUID, _known_shape("key")]
WebhookId = Annotated[UUID, _known_shape("webhook")]

__all__ = [
    "API",
    "DEFAULT_MAP",
    "NO_NUL",
    "FileId",
    "Gateway",
    "GatewayDep",
    "GenerationId",
    "JobId",
    "KeyId",
    "MapName",
    "UploadId",
    "WebhookId",
    "read_cursor",
]
