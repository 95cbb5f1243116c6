"""Idempotent requests: a request repeated with its `Idempotency-Key` is executed once.

The repeated request gets the stored response of the first one. A route supports this with a
dependency, and by storing its response in the transaction that executes the request:

    def route(gateway: GatewayDep, idempotent: IdempotentDep, ...) -> MapResponse:
        with gateway.catalog.write() as session:
            ...
            idempotent.store_response(session, 201, response)

and `idempotent.accept_job(session, job)` stores and returns the 202 of a job.

The content of a multipart form is known only after it has been received: its routes use
`IdempotentFormDep`, and execute the request in `with idempotent.claim_form(upload):`.

Stored are responses of executed requests, and 4xx responses that a repetition would get again;
never a 5xx, nor responses that depend on the caller and the time (401, 403, 408, 429). A request
without the header costs nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import AsyncIterator, Iterator
from typing import Annotated, Any
from uuid import UUID

from fastapi import Depends, Header, Request, Response
from pydantic import BaseModel
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.authentication import get_caller
from services.gateway.dependencies import GatewayContext, GatewayDep, get_map_name
from services.gateway.responses import JobAcceptedResponse
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
KEY_SECONDS = 86_400.0  # for which a key is remembered
LEASE_SECONDS = 30.0  # longer than it takes to execute a received request and commit
UNSTORED_STATUSES = (401, 403, 408, 429)

IdempotencyKeyHeader = Annotated[
    str | None,
    Header(
        alias=IDEMPOTENCY_HEADER,
        description="a unique value per request, such as a UUID: a request repeated with the same "
        "key within 24 hours is executed once and gets the same response; 1 to 255 printable ASCII "
        "characters",
    ),
]


class IdempotentReplay(Exception):
    """Raised for a request that was already executed; carries its stored response."""

    def __init__(self, stored_response: StoredResponse) -> None:
        super().__init__(stored_response.status)
        self.stored_response = stored_response


async def replay_response(request: Request, replay: Exception) -> Response:
    """Exception handler of `IdempotentReplay`."""
    assert isinstance(replay, IdempotentReplay)
    stored = replay.stored_response
    return Response(
        stored.body,
        stored.status,
        {**stored.headers, REPLAYED_HEADER: "true"},
        media_type="application/problem+json" if stored.status >= 400 else "application/json",
    )


class IdempotentRequest:
    """A request with an `Idempotency-Key`; without the header, nothing is claimed or stored."""

    def __init__(
        self, gateway: GatewayContext, request: Request, response: Response, key: str | None
    ) -> None:
        if key is not None and not re.fullmatch(IDEMPOTENCY_KEY_PATTERN, key):
            raise invalid_field_error(
                IDEMPOTENCY_HEADER, "must have 1 to 255 printable ASCII characters without spaces"
            )
        self._gateway = gateway
        self._request = request
        self._response = response
        self.key = key
        self._token: UUID | None = None
        self._response_stored = False

    @contextlib.contextmanager
    def claim_form(self, upload: StoredUpload, life_seconds: float | None = None) -> Iterator[None]:
        """Claim the key for the content of a form; the block executes the request.

        Deletes the received file if the request is refused or was already executed.
        """
        with delete_if_refused(self._gateway.store, upload.key):
            self.claim_key([upload.filename, upload.sha256, upload.fields], life_seconds)
            yield

    def claim_key(self, content: Any, life_seconds: float | None = None) -> None:
        """Claim the key: from here on only this request is executed under it.

        Args:
            content: The content of the request, serializable as JSON.
            life_seconds: How long the response is stored, at most; None for the setting.

        Raises:
            IdempotentReplay: The request was already executed.
            PlacewiseError: Those of `claim_idempotency_key`.
        """
        if self.key is None:
            return
        request = self._request
        params = [item for item in request.query_params.multi_items() if item[0] != "map"]
        fingerprinted = [request.url.path, sorted(params), content]
        identity = RequestIdentity(
            scope=_key_scope(request),
            key=self.key,
            call=f"{request.method} {request.scope['route'].path_format}",
            fingerprint=hashlib.sha256(
                json.dumps(fingerprinted, sort_keys=True).encode()
            ).hexdigest(),
        )
        with self._gateway.catalog.write() as session:
            claimed = claim_idempotency_key(
                session,
                identity,
                lease_seconds=LEASE_SECONDS,
                life_seconds=min(KEY_SECONDS, life_seconds or KEY_SECONDS),
            )
        if isinstance(claimed, StoredResponse):
            raise IdempotentReplay(claimed)
        self._token = claimed

    def store_response(
        self, session: Session, status: int, body: BaseModel, headers: dict[str, str] | None = None
    ) -> None:
        """Store the response, in the transaction that executes the request.

        A response that was stored before is replaced.
        """
        if self._token is not None:
            stored = StoredResponse(status, headers or {}, body.model_dump_json())
            store_response(session, self._token, stored)
            self._response_stored = True

    def store_job_response(self, session: Session, job: Job) -> JobAcceptedResponse:
        """Add a job to the transaction, and store and return its 202 response."""
        session.add(job)
        session.flush()
        accepted = JobAcceptedResponse.of(job, get_map_name(self._request))
        self.store_response(session, 202, accepted, accepted.headers)
        return accepted

    def accept_job(self, session: Session, job: Job) -> JobAcceptedResponse:
        """As `store_job_response`, and sets the headers of this request's response."""
        accepted = self.store_job_response(session, job)
        self._response.headers.update(accepted.headers)
        return accepted

    def replace_response(
        self, status: int, body: BaseModel, headers: dict[str, str] | None = None
    ) -> None:
        """Replace the stored response in a transaction of its own."""
        if self._token is not None:
            with self._gateway.catalog.write() as session:
                self.store_response(session, status, body, headers)

    def store_refusal(self, error: PlacewiseError) -> None:
        """Store the refusal of a request, unless a repetition might succeed."""
        if (
            self._token is None
            or self._response_stored
            or error.status >= 500
            or error.status in UNSTORED_STATUSES
        ):
            return
        response = problem_response(error, self._request)
        stored = StoredResponse(error.status, {}, bytes(response.body).decode())
        # Conflict: a repetition took over the expired lease, and its response counts.
        with contextlib.suppress(Conflict), self._gateway.catalog.write() as session:
            store_response(session, self._token, stored)
            self._response_stored = True

    def release_key(self) -> None:
        """Release the key if no response was stored under it."""
        if self._token is not None and not self._response_stored:
            with self._gateway.catalog.write() as session:
                release_idempotency_key(session, self._token)


@contextlib.contextmanager
def delete_if_refused(store: ObjectStore, key: str) -> Iterator[None]:
    """Delete a received object if the block refuses the request, or replays a response.

    Not for other exceptions: after a lost connection the row may have been committed.
    """
    try:
        yield
    except (PlacewiseError, IdempotentReplay):
        store.delete(key)
        raise


async def _idempotent_form_request(
    request: Request, response: Response, gateway: GatewayDep, key: IdempotencyKeyHeader = None
) -> AsyncIterator[IdempotentRequest]:
    """Dependency for streamed bodies: the route calls `claim_form` or `claim_key` itself."""
    idempotent = IdempotentRequest(gateway, request, response, key)
    try:
        yield idempotent
    except PlacewiseError as error:
        if key is not None:
            await run_in_threadpool(idempotent.store_refusal, error)
        raise
    finally:
        if key is not None:
            await run_in_threadpool(idempotent.release_key)


async def _idempotent_request(
    request: Request, idempotent: Annotated[IdempotentRequest, Depends(_idempotent_form_request)]
) -> IdempotentRequest:
    """Dependency for requests with a JSON body or none; claims the key."""
    if idempotent.key is not None:
        content = hashlib.sha256(await request.body()).hexdigest()
        await run_in_threadpool(idempotent.claim_key, content)
    return idempotent


def _key_scope(request: Request) -> str:
    """Namespace of the idempotency key: the caller and the map, hashed."""
    scope = [get_caller(request).identity, get_map_name(request)]
    return hashlib.sha256(json.dumps(scope).encode()).hexdigest()


IdempotentDep = Annotated[IdempotentRequest, Depends(_idempotent_request)]
IdempotentFormDep = Annotated[IdempotentRequest, Depends(_idempotent_form_request)]
