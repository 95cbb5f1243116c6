"""Routes of webhooks and their delivery logs. They need the scope `admin`."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Query
from pydantic import Field, model_validator

from services.gateway.authentication import ADMIN
from services.gateway.dependencies import NO_PARAMETERS, GatewayDep, PageParams, WebhookId
from shared.catalog.database.base import list_newest
from shared.catalog.webhooks import (
    Delivery,
    DeliveryState,
    EventKind,
    Webhook,
    create_webhook,
    delete_webhook,
    get_webhook,
)
from shared.errors import PlacewiseError, invalid_field_error
from shared.http.request_model import RequestModel
from shared.responses import ResponseModel
from shared.security.webhook_targets import parse_webhook_url, resolve_webhook_target

router = APIRouter(tags=["administration"])


class CreateWebhookRequest(RequestModel):
    url: str = Field(
        min_length=1,
        max_length=2000,
        description="an HTTPS URL with a public address; redirects are not followed",
    )
    events: list[EventKind] = Field(min_length=1, max_length=100)


class WebhookResponse(ResponseModel):
    id: UUID
    url: str
    events: list[EventKind]
    created_at: datetime


class CreatedWebhookResponse(WebhookResponse):
    secret: str = Field(description="signs the events; it is shown only once")


class DeliveryResponse(ResponseModel):
    id: UUID
    event_id: UUID = Field(description="sent as `webhook-id: msg_<event_id>` in every attempt")
    event: EventKind
    state: DeliveryState
    attempts: int
    next_attempt_at: datetime | None = Field(description="null unless it is pending")
    last_status: int | None = Field(description="HTTP status of the last response")
    last_error: str | None
    created_at: datetime
    ended_at: datetime | None

    @classmethod
    def of(cls, delivery: Delivery) -> DeliveryResponse:
        response = cls.model_validate(delivery)
        pending = response.state == DeliveryState.PENDING
        return response if pending else response.model_copy(update={"next_attempt_at": None})


class DeliveriesResponse(ResponseModel):
    deliveries: list[DeliveryResponse]
    next_cursor: str | None


@router.get("/webhooks", dependencies=[ADMIN, NO_PARAMETERS])
def list_webhooks(gateway: GatewayDep) -> list[WebhookResponse]:
    """List webhooks, newest first, without their secrets."""
    with gateway.catalog.read() as session:
        webhooks = list_newest(session, Webhook, Webhook.deleted_at.is_(None))
    return [WebhookResponse.model_validate(webhook) for webhook in webhooks]


@router.post(
    "/webhooks",
    operation_id="create_webhook",
    status_code=201,
    dependencies=[ADMIN, NO_PARAMETERS],
)
def register_webhook(gateway: GatewayDep, body: CreateWebhookRequest) -> CreatedWebhookResponse:
    """Create a webhook: events are POSTed to the URL, signed with the returned secret.

    The secret is shown only once, so this endpoint does not support `Idempotency-Key`.
    """
    allow_private = gateway.settings.webhook_private_addresses
    target = parse_webhook_url(body.url, allow_private=allow_private)
    try:
        # Catches typing errors early. The host is resolved and checked again for each delivery.
        resolve_webhook_target(target, allow_private=allow_private)
    except PlacewiseError as error:
        raise invalid_field_error("url", error.detail) from error
    with gateway.catalog.write() as session:
        webhook = create_webhook(session, body.url, body.events)
        return CreatedWebhookResponse.model_validate(webhook)


@router.delete(
    "/webhooks/{webhook_id}",
    operation_id="delete_webhook",
    dependencies=[ADMIN, NO_PARAMETERS],
)
def remove_webhook_by_id(gateway: GatewayDep, webhook_id: WebhookId) -> WebhookResponse:
    """Delete a webhook, its pending deliveries and its delivery log."""
    with gateway.catalog.write() as session:
        return WebhookResponse.model_validate(delete_webhook(session, webhook_id))


class DeliveriesParams(PageParams):
    @model_validator(mode="before")
    @classmethod
    def _ignore_map(cls, values: dict[str, Any]) -> dict[str, Any]:
        """Accept `map`, which clients send with every request: a webhook has none."""
        return {name: value for name, value in values.items() if name != "map"}


@router.get("/webhooks/{webhook_id}/deliveries", dependencies=[ADMIN])
def list_deliveries(
    gateway: GatewayDep, webhook_id: WebhookId, query: Annotated[DeliveriesParams, Query()]
) -> DeliveriesResponse:
    """List the deliveries of a webhook, newest first, kept for 30 days."""
    with gateway.catalog.read() as session:
        is_of_webhook = Delivery.webhook_id == get_webhook(session, webhook_id).id
        page, next_cursor = query.read(session, Delivery, is_of_webhook)
    return DeliveriesResponse(
        deliveries=[DeliveryResponse.of(delivery) for delivery in page], next_cursor=next_cursor
    )
