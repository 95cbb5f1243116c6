"""Every error leaves as an RFC 9457 problem with a stable `code`, never with a trace."""

from __future__ import annotations

import logging
import math
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, ConfigDict
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from shared.catalog.database_errors import to_unavailable
from shared.errors import InvalidRequest, PlacewiseError, Unprocessable
from shared.ids import new_id
from shared.telemetry.tracing import REQUEST_ID_HEADER

log = logging.getLogger(__name__)

RETRY_AFTER_SECONDS = 2  # of a 503 that knows no better
REQUEST_ID_SCOPE_KEY = "placewise.request_id"
"""Of an ASGI scope: the call's id, where the service gives its calls ids."""
CLOSED_WITH = "placewise.closed_with"
"""Of an ASGI scope: what the server answered itself before it closed the connection."""
CLIENT_GONE = 499
"""The status of a call whose client has closed the connection: for logs and figures alone."""
HTTP_CODES = {400: "malformed_body", 404: "path_not_found", 405: "method_not_allowed"}


class Problem(BaseModel):
    """RFC 9457; `code` is stable, `detail` is for people. More members may follow."""

    model_config = ConfigDict(extra="allow")

    type: str
    title: str
    status: int
    detail: str
    code: str


# What the description of every call promises beside its success.
PROBLEM_RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": {
        "description": "The request can't be met; `code` says why.",
        "content": {"application/problem+json": {"schema": Problem.model_json_schema()}},
    },
    "5XX": {
        "description": "Not the caller's fault; with `Retry-After` it may work later.",
        "content": {"application/problem+json": {"schema": Problem.model_json_schema()}},
    },
}

# The same for whoever calls without a key, with too little of one, or too often.
AUTHENTICATION_RESPONSES: dict[int | str, dict[str, Any]] = {
    401: {**PROBLEM_RESPONSES["4XX"], "description": "No key, or one that is no longer good."},
    403: {**PROBLEM_RESPONSES["4XX"], "description": "The key lacks the scope of this call."},
    429: {
        **PROBLEM_RESPONSES["4XX"],
        "description": "Too much at once; again after `Retry-After` seconds.",
    },
}


def install_exception_handlers(app: FastAPI) -> None:
    """Turn whatever is raised in a route into a problem document."""
    app.add_exception_handler(PlacewiseError, _handle_placewise_error)
    app.add_exception_handler(RequestValidationError, _handle_validation_error)
    app.add_exception_handler(HTTPException, _handle_http_exception)
    app.add_exception_handler(SQLAlchemyError, _handle_database_error)
    app.add_exception_handler(ClientDisconnect, _on_client_gone)
    app.add_exception_handler(Exception, handle_unexpected_error)


def problem_response(error: PlacewiseError, request: Request) -> JSONResponse:
    headers = {}
    # Where the call's log does not reach: the handler of what nobody foresaw.
    if (request_id := request.scope.get(REQUEST_ID_SCOPE_KEY)) is not None:
        headers[REQUEST_ID_HEADER] = request_id
    if error.status == 401:
        headers["WWW-Authenticate"] = "Bearer"
    wait = error.extra.get("retry_after_seconds")
    if wait is None and error.status == 503:
        wait = RETRY_AFTER_SECONDS
    if wait is not None:
        headers["Retry-After"] = str(math.ceil(wait))
    if error.status == 413:
        headers["Connection"] = "close"  # the rest of the body stays unread
    return JSONResponse(
        {**error.as_problem(), "instance": request.url.path},
        status_code=error.status,
        headers=headers,
        media_type="application/problem+json",
    )


async def _handle_placewise_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, PlacewiseError)
    if error.status >= 500:
        log.error("%s %s: %s", request.method, request.url.path, error.detail)
    else:
        log.debug("%s %s: %s", request.method, request.url.path, error.detail)
    return problem_response(error, request)


async def _handle_validation_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    faults = error.errors()
    if any(fault["type"] == "json_invalid" for fault in faults):
        problem: PlacewiseError = InvalidRequest("malformed_body", "The body is not valid JSON.")
    else:
        errors = [
            {
                "field": ".".join(str(part) for part in fault["loc"][1:]),
                "detail": fault["msg"],
            }
            for fault in faults
        ]
        named = "; ".join(f"{e['field'] or 'body'}: {e['detail']}" for e in errors)
        problem = Unprocessable("invalid_field", named, errors=errors)
    return problem_response(problem, request)


async def _handle_http_exception(request: Request, error: Exception) -> JSONResponse:
    """Unknown paths and methods, as Starlette raises them."""
    assert isinstance(error, HTTPException)
    code = HTTP_CODES.get(error.status_code, "http_error")
    return JSONResponse(
        {
            "type": f"urn:placewise:problem:{code}",
            "title": str(error.detail),
            "status": error.status_code,
            "detail": f"{request.method} {request.url.path}: {error.detail}. See /docs.",
            "code": code,
            "instance": request.url.path,
        },
        status_code=error.status_code,
        headers=error.headers,
        media_type="application/problem+json",
    )


async def _handle_database_error(request: Request, error: Exception) -> JSONResponse:
    unavailable = to_unavailable(error)
    if unavailable is None:  # a bug: another try would meet it again
        return await handle_unexpected_error(request, error)
    return await _handle_placewise_error(request, unavailable)


async def _on_client_gone(request: Request, error: Exception) -> Response:
    return Response(status_code=CLIENT_GONE)  # nobody gets it


async def handle_unexpected_error(request: Request, error: Exception) -> JSONResponse:
    """What is said of a fault of ours: an id, by which the log tells the rest."""
    request_id = request.scope.get(REQUEST_ID_SCOPE_KEY) or str(new_id())
    log.error(
        "%s %s failed (request %s)",
        request.method,
        request.url.path,
        request_id,
        exc_info=error,
        extra={"request_id": request_id},
    )
    problem = PlacewiseError(
        "internal_error",
        f"Something went wrong here; the server's log says what, at {request_id}.",
        request_id=request_id,
    )
    return problem_response(problem, request)
