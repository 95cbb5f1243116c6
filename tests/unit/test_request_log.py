"""The request log's middleware for requests that the server's shutdown cancels."""

from __future__ import annotations

import asyncio
import json

import pytest
from starlette.types import Message, Receive, Scope, Send

from services.request_log import RequestLogMiddleware, RequestRecord

START: Message = {"type": "http.response.start", "status": 200, "headers": []}


def cancelled_while_it_runs(*, started: bool) -> tuple[list[Message], list[RequestRecord]]:
    """Cancel a request as uvicorn does; return what was sent, and the logged records."""
    sent: list[Message] = []
    records: list[RequestRecord] = []

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        if started:
            await send(START)
        await asyncio.sleep(60)

    async def send(message: Message) -> None:
        sent.append(message)

    async def receive() -> Message:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def run() -> None:
        scope = {"type": "http", "method": "POST", "path": "/api/v1/similarity/1", "headers": []}
        middleware = RequestLogMiddleware(app, on_end=records.append)
        task = asyncio.create_task(middleware(scope, receive, send))
        await asyncio.sleep(0)
        task.cancel()
        await task

    asyncio.run(run())
    return sent, records


def test_a_request_that_the_shutdown_cancels_is_answered_with_a_503_to_repeat_it() -> None:
    sent, (record,) = cancelled_while_it_runs(started=False)
    headers = dict(sent[0]["headers"])
    assert (sent[0]["status"], record.status) == (503, 503)
    assert b"retry-after" in headers
    assert b"x-request-id" in headers
    assert json.loads(sent[1]["body"])["code"] == "stopping"


def test_a_response_that_has_begun_is_cut_when_the_shutdown_cancels_it() -> None:
    with pytest.raises(asyncio.CancelledError):
        cancelled_while_it_runs(started=True)
