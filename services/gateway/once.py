"""`Idempotency-Key`: a call that is repeated under its key is done once and answered the same.

A route takes part with one dependency, and one line in the transaction that makes its effect:

    def route(gateway: GatewayDep, once: OnceDep, ...) -> Answer:
        with gateway.catalog.write() as session:
            ...
            once.keep(session, 201, answer)

A form's bytes are known only once they have come: there it is `OnceFormDep`, and
`await once.begin_form(gateway.store, received)` after `receive_file`.

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

from services.gateway.context import DEFAULT_MAP, Gateway, GatewayDep
from services.gateway.key_check import caller_of
from services.gateway.schemas import job_started
from shared.catalog.idempotency import (
    CallMade,
    KeptAnswer,
    claim_key,
    keep_answer,
    release_key,
)
from shared.errors import Conflict, PlacewiseError, invalid_field
from shared.intake.received import Received
from shared.jobs import Job
from shared.objects import ObjectStore
from shared.problems import problem_response

HEADER = "Idempotency-Key"
REPLAYED = "Idempotent-Replayed"
KEY = r"[!-~]{1,255}"
LEASE_SECONDS = 30.0  # more than passes between a whole request and its committed effect
NOT_KEPT = (401, 403, 408, 429)

KeyHeader = Annotated[
    str | None,
    Header(
        alias=HEADER,
        description="a new one for each call (a UUID, say): repeated with it, the call is done "
        "once and answered the same, for 24 hours; 1 to 255 printable ASCII characters",
    ),
]


class Replay(Exception):
    """The call was done already; this is its answer."""

    def __init__(self, answer: KeptAnswer) -> None:
        super().__init__(answer.status)
        self.answer = answer


async def answer_again(request: Request, replay: Exception) -> Response:
    """The handler of Replay."""
    assert isinstance(replay, Replay)
    kept = replay.answer
    return Response(
        kept.body,
        kept.status,
        {**kept.headers, REPLAYED: "true"},
        media_type="application/problem+json" if kept.status >= 400 else "application/json",
    )


class Once:
    """One request under its key; without one, everything here does nothing."""

    def __init__(self, gateway: Gateway, request: Request, key: str | None) -> None:
        if key is not None and not re.fullmatch(KEY, key):
            raise invalid_field(HEADER, "has 1 to 255 printable ASCII characters and no blanks")
        self._gateway = gateway
        self._request = request
        self._key = key
        self._token: UUID | None = None
        self._kept = False

    async def begin_form(
        self, store: ObjectStore, received: Received, *, life_seconds: float | None = None
    ) -> None:
        """`begin` with what a form said. Received bytes that the call won't need are removed."""
        content = [received.filename, received.sha256, received.fields]
        try:
            await run_in_threadpool(self.begin, content, life_seconds)
        except (PlacewiseError, Replay):
            await run_in_threadpool(store.delete, received.key)
            raise

    def begin(self, content: Any, life_seconds: float | None = None) -> None:
        """The call is this one's to do from here on. `content` is what it says, as JSON.

        Raises Replay when it was done already, and as `claim_key` does.
        """
        if self._key is None:
            return
        request = self._request
        asked = [item for item in request.query_params.multi_items() if item[0] != "map"]
        said = [request.url.path, sorted(asked), content]
        made = CallMade(
            scope=_scope(request),
            key=self._key,
            call=f"{request.method} {request.scope['route'].path_format}",
            fingerprint=hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest(),
        )
        life = self._gateway.settings.idempotency_key_seconds
        with self._gateway.catalog.write() as session:
            claimed = claim_key(
                session,
                made,
                lease_seconds=LEASE_SECONDS,
                life_seconds=min(life, life_seconds or life),
            )
        if isinstance(claimed, KeptAnswer):
            raise Replay(claimed)
        self._token = claimed

    def keep(
        self,
        session: Session,
        status: int,
        answer: BaseModel,
        headers: dict[str, str] | None = None,
    ) -> None:
        """What the call is answered, in the transaction that makes its effect. Kept again, it
        replaces what was kept before."""
        if self._token is not None:
            kept = KeptAnswer(status, headers or {}, answer.model_dump_json())
            keep_answer(session, self._token, kept)
            self._kept = True

    def keep_job(self, session: Session, job: Job) -> None:
        """The 202 of a job that this transaction queues."""
        started = job_started(job, _map_name(self._request))
        self.keep(session, 202, started, {"Location": started.status_url, "Retry-After": "1"})

    def replace(
        self, status: int, answer: BaseModel, headers: dict[str, str] | None = None
    ) -> None:
        """`keep` in a transaction of its own, once an effect that was kept has come further."""
        if self._token is not None:
            with self._gateway.catalog.write() as session:
                self.keep(session, status, answer, headers)

    def keep_refusal(self, error: PlacewiseError) -> None:
        """The call is refused, and would be again."""
        if self._token is None or self._kept or error.status >= 500 or error.status in NOT_KEPT:
            return
        response = problem_response(error, self._request)
        kept = KeptAnswer(error.status, {}, bytes(response.body).decode())
        # Whoever took the call over meanwhile has the last word.
        with contextlib.suppress(Conflict), self._gateway.catalog.write() as session:
            keep_answer(session, self._token, kept)
            self._kept = True

    def end(self) -> None:
        """Give back a key under which nothing was done."""
        if self._token is not None and not self._kept:
            with self._gateway.catalog.write() as session:
                release_key(session, self._token)


async def once_of_form(
    request: Request, gateway: GatewayDep, key: KeyHeader = None
) -> AsyncIterator[Once]:
    """A call whose content is known later: the route calls `begin_form`."""
    once = Once(gateway, request, key)
    try:
        yield once
    except PlacewiseError as error:
        await run_in_threadpool(once.keep_refusal, error)
        raise
    finally:
        await run_in_threadpool(once.end)


async def once_of_body(request: Request, once: Annotated[Once, Depends(once_of_form)]) -> Once:
    """A call with a JSON body, or none: begun already."""
    body = await request.body()
    await run_in_threadpool(once.begin, hashlib.sha256(body).hexdigest())
    return once


def _scope(request: Request) -> str:
    """Whose key it is: the caller's, in one map."""
    whose = [caller_of(request).who, _map_name(request)]
    return hashlib.sha256(json.dumps(whose).encode()).hexdigest()


def _map_name(request: Request) -> str:
    return request.query_params.get("map", DEFAULT_MAP)


OnceDep = Annotated[Once, Depends(once_of_body)]
OnceFormDep = Annotated[Once, Depends(once_of_form)]
