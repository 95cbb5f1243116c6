"""Idempotent requests: a request repeated with its `Idempotency-Key` is executed once.

The repeated request gets the stored response of the first one. A route supports this with a
dependency, and by storing its response in the transaction that executes the request:

    def route(gateway: GatewayDep, idempotent: IdempotentDep, ...) -> MapResponse:
        with gateway.catalog.write() as session:
            ...
            idempotent.store_response(session, 201, response)

and `idempotent.accept_job(session, job)` stores and returns the 202 of a job.

The content of a multipart form is known only after it has been received: its routes use
`IdempotentFormDep`, and execute the request in `with idempotent.begin_form(upload):`.

Refusals are not stored: a repeated request is checked again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import AsyncIterator, Iterator
from typing import Annotated, Any

from fastapi import Depends, Header, Request, Response
from pydantic import BaseModel
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from services.gateway.authentication import get_caller
from services.gateway.dependencies import GatewayContext, GatewayDep, get_map_name
from services.gateway.responses import JobAcceptedResponse
from shared.catalog.database.base import db_now_plus, insert_row
from shared.catalog.idempotency import StoredResponse, find_response, store_response
from shared.errors import PlacewiseError, invalid_field_error
from shared.ingest.validation import StoredUpload
from shared.jobs import Job

IDEMPOTENCY_HEADER = "Idempotency-Key"
REPLAYED_HEADER = "Idempotent-Replayed"
IDEMPOTENCY_KEY_PATTERN = r"[!-~]{1,255}"
KEY_SECONDS = 86_400.0  # for which a key is remembered

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

    def __init__(self, status: int, headers: dict[str, str], body: str) -> None:
        super().__init__(status)
        self.status, self.headers, self.body = status, headers, body


async def replay_response(request: Request, replay: Exception) -> Response:
    """Exception handler of `IdempotentReplay`."""
    assert isinstance(replay, IdempotentReplay)
    headers = {**replay.headers, REPLAYED_HEADER: "true"}
    return Response(replay.body, replay.status, headers, media_type="application/json")


class IdempotentRequest:
    """A request with an `Idempotency-Key`; without the header, nothing is looked up or stored."""

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
        self._fingerprint: str | None = None
        """Of the request, once its content is known; None without a key."""
        self._life_seconds = KEY_SECONDS

    @contextlib.contextmanager
    def begin_form(self, upload: StoredUpload, life_seconds: float = KEY_SECONDS) -> Iterator[None]:
        """As `begin`, with the content of a form; the block executes the request.

        Deletes the received file if the request is refused or was already executed. Not after other
        exceptions: after a lost connection the row may have been committed.
        """
        try:
            self.begin([upload.filename, upload.sha256, upload.fields], life_seconds)
            yield
        except (PlacewiseError, IdempotentReplay):
            self._gateway.store.delete(upload.key)
            raise

    def begin(self, content: Any, life_seconds: float = KEY_SECONDS) -> None:
        """Begin to execute the request, unless that was done before.

        Args:
            content: The content of the request, serializable as JSON.
            life_seconds: How long its response is stored.

        Raises:
            IdempotentReplay: The request was already executed.
            Unprocessable: `idempotency_key_reused`.
        """
        if self.key is None:
            return
        request = self._request
        params = [item for item in request.query_params.multi_items() if item[0] != "map"]
        call = [request.method, request.url.path, sorted(params), content]
        self._fingerprint = hashlib.sha256(json.dumps(call, sort_keys=True).encode()).hexdigest()
        self._life_seconds = life_seconds
        self.replay_if_executed()

    def replay_if_executed(self) -> None:
        """Raise as `begin` does, if another process has executed the request meanwhile."""
        if self.key is None or self._fingerprint is None:
            return
        scope = _key_scope(self._request)
        with self._gateway.catalog.read() as session:
            stored = find_response(session, scope, self.key, self._fingerprint)
        if stored is not None:
            raise IdempotentReplay(stored.status, stored.headers, stored.body)

    def store_response(
        self, session: Session, status: int, body: BaseModel, headers: dict[str, str] | None = None
    ) -> None:
        """Store the response, in the transaction that executes the request.

        Raises:
            IdempotentReplay: Another process was faster; the transaction is rolled back.
        """
        if self.key is None or self._fingerprint is None:
            return
        new = StoredResponse(
            scope=_key_scope(self._request),
            key=self.key,
            fingerprint=self._fingerprint,
            status=status,
            headers=headers or {},
            body=body.model_dump_json(),
            expires_at=db_now_plus(self._life_seconds),
        )
        stored = store_response(session, new)
        if stored is not new:
            raise IdempotentReplay(stored.status, stored.headers, stored.body)

    def store_job_response(self, session: Session, job: Job) -> JobAcceptedResponse:
        """Add a job to the transaction, and store and return its 202 response."""
        insert_row(session, job)
        accepted = JobAcceptedResponse.of(job, get_map_name(self._request))
        self.store_response(session, 202, accepted, accepted.headers)
        return accepted

    def accept_job(self, session: Session, job: Job) -> JobAcceptedResponse:
        """As `store_job_response`, and sets the headers of this request's response."""
        accepted = self.store_job_response(session, job)
        self._response.headers.update(accepted.headers)
        return accepted


async def _idempotent_form_request(
    request: Request, response: Response, gateway: GatewayDep, key: IdempotencyKeyHeader = None
) -> AsyncIterator[IdempotentRequest]:
    """Dependency for streamed bodies: the route calls `begin_form` or `begin` itself."""
    idempotent = IdempotentRequest(gateway, request, response, key)
    try:
        yield idempotent
    except PlacewiseError:
        # The reason may be that another process has executed the same request meanwhile.
        await run_in_threadpool(idempotent.replay_if_executed)
        raise


async def _idempotent_request(
    request: Request, idempotent: Annotated[IdempotentRequest, Depends(_idempotent_form_request)]
) -> IdempotentRequest:
    """Dependency for requests with a JSON body or none."""
    if idempotent.key is not None:
        content = hashlib.sha256(await request.body()).hexdigest()
        await run_in_threadpool(idempotent.begin, content)
    return idempotent


def _key_scope(request: Request) -> str:
    """Namespace of the idempotency key: the caller and the map, hashed."""
    scope = [get_caller(request).identity, get_map_name(request)]
    return hashlib.sha256(json.dumps(scope).encode()).hexdigest()


IdempotentDep = Annotated[IdempotentRequest, Depends(_idempotent_request)]
IdempotentFormDep = Annotated[IdempotentRequest, Depends(_idempotent_form_request)]
