"""`Idempotency-Key`: a call that is repeated under its key is done once and answered the same.

A route takes part with one dependency, and one line in the transaction that makes its effect:

    def route(gateway: GatewayDep, once: OnceDep, ...) -> Answer:
        with gateway.catalog.write() as session:
            ...
            once.keep(session, 201, answer)

A form's bytes are known only once they have come: there it is `IdempotentFormDep`, and
`await once.begin_form(gateway.store, received)` after `store_form_file`.

Kept are answers to what was done, and refusals (4xx) that would be the same again; never a 5xx, nor
what depends on who asks and when (401, 403, 408, 429). A call without a key costs nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import AsyncIterator
from typing import Annotated, Any
from uuid import UUID

from fastapi import Depends, Header, Request, Response
from pydantic import BaseModel
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.authentication import get_caller
from services.gateway.dependencies import DEFAULT_MAP, GatewayContext, GatewayDep
from services.gateway.schemas import to_job_accepted
from shared.catalog.idempotency import (
    RequestIdentity,
    StoredResponse,
    claim_idempotency_key,
    release_idempotency_key,
    store_response,
)
from shared.errors import Conflict, PlacewiseError, invalid_field_error
from shared.http.problem_details import problem_response
from shared.ingest.validation import StoredUpload
from shared.jobs import Job
from shared.storage import ObjectStore

IDEMPOTENCY_HEADER = "Idempotency-Key"
REPLAYED_HEADER = "Idempotent-Replayed"
IDEMPOTENCY_KEY_PATTERN = r"[!-~]{1,255}"
LEASE_SECONDS = 30.0  # more than passes between a whole request and its committed effect
UNSTORED_STATUSES = (401, 403, 408, 429)

IdempotencyKeyHeader = Annotated[
    str | None,
    Header(
        alias=IDEMPOTENCY_HEADER,
        description="a new one for each call (a UUID, say): repeated with it, the call is done "
        "once and answered the same, for 24 hours; 1 to 255 printable ASCII characters",
    ),
]


class IdempotentReplay(Exception):
    """The call was done already; this is its answer."""

    def __init__(self, answer: StoredResponse) -> None:
        super().__init__(answer.status)
        self.stored_response = answer


async def replay_response(request: Request, replay: Exception) -> Response:
    """The handler of Replay."""
    assert isinstance(replay, IdempotentReplay)
    kept = replay.stored_response
    return Response(
        kept.body,
        kept.status,
        {**kept.headers, REPLAYED_HEADER: "true"},
        media_type="application/problem+json" if kept.status >= 400 else "application/json",
    )


class IdempotentRequest:
    """One request under its key; without one, everything here does nothing."""

    def __init__(self, gateway: GatewayContext, request: Request, key: str | None) -> None:
        if key is not None and not re.fullmatch(IDEMPOTENCY_KEY_PATTERN, key):
            raise invalid_field_error(
                IDEMPOTENCY_HEADER, "has 1 to 255 printable ASCII characters and no blanks"
            )
        self._gateway = gateway
        self._request = request
        self._key = key
        self._token: UUID | None = None
        self._response_stored = False

    async def claim_form(
        self, store: ObjectStore, received: StoredUpload, *, life_seconds: float | None = None
    ) -> None:
        """`begin` with what a form said. Received bytes that the call won't need are removed."""
        content = [received.filename, received.sha256, received.fields]
        try:
            await run_in_threadpool(self.claim_key, content, life_seconds)
        except (PlacewiseError, IdempotentReplay):
            await run_in_threadpool(store.delete, received.key)
            raise

    def claim_key(self, content: Any, life_seconds: float | None = None) -> None:
        """The call is this one's to do from here on. `content` is what it says, as JSON.

        Raises Replay when it was done already, and as `claim_idempotency_key` does.
        """
        if self._key is None:
            return
        request = self._request
        asked = [item for item in request.query_params.multi_items() if item[0] != "map"]
        said = [request.url.path, sorted(asked), content]
        made = RequestIdentity(
            scope=_key_scope(request),
            key=self._key,
            call=f"{request.method} {request.scope['route'].path_format}",
            fingerprint=hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest(),
        )
        life = self._gateway.settings.idempotency_key_seconds
        with self._gateway.catalog.write() as session:
            claimed = claim_idempotency_key(
                session,
                made,
                lease_seconds=LEASE_SECONDS,
                life_seconds=min(life, life_seconds or life),
            )
        if isinstance(claimed, StoredResponse):
            raise IdempotentReplay(claimed)
        self._token = claimed

    def store_response(
        self,
        session: Session,
        status: int,
        answer: BaseModel,
        headers: dict[str, str] | None = None,
    ) -> None:
        """What the call is answered, in the transaction that makes its effect. Kept again, it
        replaces what was kept before."""
        if self._token is not None:
            kept = StoredResponse(status, headers or {}, answer.model_dump_json())
            store_response(session, self._token, kept)
            self._response_stored = True

    def store_job_response(self, session: Session, job: Job) -> None:
        """The 202 of a job that this transaction queues."""
        started = to_job_accepted(job, _map_name(self._request))
        self.store_response(
            session, 202, started, {"Location": started.status_url, "Retry-After": "1"}
        )

    def replace_response(
        self, status: int, answer: BaseModel, headers: dict[str, str] | None = None
    ) -> None:
        """`keep` in a transaction of its own, once an effect that was kept has come further."""
        if self._token is not None:
            with self._gateway.catalog.write() as session:
                self.store_response(session, status, answer, headers)

    def store_refusal(self, error: PlacewiseError) -> None:
        """The call is refused, and would be again."""
        if (
            self._token is None
            or self._response_stored
            or error.status >= 500
            or error.status in UNSTORED_STATUSES
        ):
            return
        response = problem_response(error, self._request)
        kept = StoredResponse(error.status, {}, bytes(response.body).decode())
        # Whoever took the call over meanwhile has the last word.
        with contextlib.suppress(Conflict), self._gateway.catalog.write() as session:
            store_response(session, self._token, kept)
            self._response_stored = True

    def release_key(self) -> None:
        """Give back a key under which nothing was done."""
        if self._token is not None and not self._response_stored:
            with self._gateway.catalog.write() as session:
                release_idempotency_key(session, self._token)


async def idempotent_form_request(
    request: Request, gateway: GatewayDep, key: IdempotencyKeyHeader = None
) -> AsyncIterator[IdempotentRequest]:
    """A call whose content is known later: the route calls `begin_form`."""
    once = IdempotentRequest(gateway, request, key)
    try:
        yield once
    except PlacewiseError as error:
        await run_in_threadpool(once.store_refusal, error)
        raise
    finally:
        await run_in_threadpool(once.release_key)


async def idempotent_request(
    request: Request, idempotent: Annotated[IdempotentRequest, Depends(idempotent_form_request)]
) -> IdempotentRequest:
    """A call with a JSON body, or none: begun already."""
    body = await request.body()
    await run_in_threadpool(idempotent.claim_key, hashlib.sha256(body).hexdigest())
    return idempotent


def _key_scope(request: Request) -> str:
    """Whose key it is: the caller's, in one map."""
    whose = [get_caller(request).identity, _map_name(request)]
    return hashlib.sha256(json.dumps(whose).encode()).hexdigest()


def _map_name(request: Request) -> str:
    return request.query_params.get("map", DEFAULT_MAP)


IdempotentDep = Annotated[IdempotentRequest, Depends(idempotent_request)]
IdempotentFormDep = Annotated[IdempotentRequest, Depends(idempotent_form_request)]
