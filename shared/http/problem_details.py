"""Exception handlers that convert every error into an RFC 9457 problem document.

Each has a stable `code`; a traceback is never sent, only logged.
"""

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

from shared.catalog.database.errors import reason_of, to_unavailable
from shared.errors import InvalidRequest, PlacewiseError, Unprocessable, shorten
from shared.ids import new_id
from shared.telemetry.request_ids import REQUEST_ID_HEADER

log = logging.getLogger(__name__)

RETRY_AFTER_SECONDS = 2  # default of a 503 without `retry_after_seconds`
REQUEST_ID_SCOPE_KEY = "placewise.request_id"
"""ASGI scope key of the request id, in services that assign one."""
MAX_REPORTED_ERRORS = 20  # of invalid fields
MAX_FIELD_CHARACTERS = 200
CLIENT_GONE = 499
"""Status of a request whose client closed the connection; only for logs and metrics."""
HTTP_CODES = {400: "malformed_body", 404: "path_not_found", 405: "method_not_allowed"}


class Problem(BaseModel):
    """An RFC 9457 problem document; `code` is stable, `detail` is for people.

    There may be further members."""

    model_config = ConfigDict(extra="allow")

    type: str
    title: str
    status: int
    detail: str
    code: str


def _described(description: str) -> dict[str, Any]:
    schema = Problem.model_json_schema()
    return {
        "description": description,
        "content": {"application/problem+json": {"schema": schema}},
    }


# The error responses of every operation in the OpenAPI description.
PROBLEM_RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": _described("The request was rejected; `code` gives the reason."),
    "5XX": _described("A failure of the server; retry after `Retry-After` seconds if it is set."),
}

# The error responses of authentication, authorization and the rate limit.
AUTHENTICATION_RESPONSES: dict[int | str, dict[str, Any]] = {
    401: _described("The API key is missing, unknown, revoked or expired."),
    403: _described("The API key lacks the scope of this operation."),
    429: _described("Rate limit, quota or backpressure; retry after `Retry-After` seconds."),
}


def install_exception_handlers(app: FastAPI) -> None:
    """Register the handlers that convert exceptions of routes into problem documents."""
    app.add_exception_handler(PlacewiseError, _handle_placewise_error)
    app.add_exception_handler(RequestValidationError, _handle_validation_error)
    app.add_exception_handler(HTTPException, _handle_http_exception)
    app.add_exception_handler(SQLAlchemyError, _handle_database_error)
    app.add_exception_handler(ClientDisconnect, _handle_client_disconnect)
    app.add_exception_handler(Exception, handle_unexpected_error)


def problem_response(error: PlacewiseError, request: Request) -> JSONResponse:
    """Return the problem document of an error, with its headers."""
    headers = {}
    # Set here too, since the response of an unhandled exception bypasses the request log.
    if (request_id := request.scope.get(REQUEST_ID_SCOPE_KEY)) is not None:
        headers[REQUEST_ID_HEADER] = request_id
    if error.status == 401:
        headers["WWW-Authenticate"] = "Bearer"
    retry_after = error.extra.get("retry_after_seconds")
    if retry_after is None and error.status == 503:
        retry_after = RETRY_AFTER_SECONDS
    if retry_after is not None:
        headers["Retry-After"] = str(math.ceil(retry_after))
    if error.status in (408, 413):
        headers["Connection"] = "close"  # the rest of the body is not read
    return JSONResponse(
        {**error.as_problem(), "instance": request.url.path},
        status_code=error.status,
        headers=headers,
        media_type="application/problem+json",
    )


async def _handle_placewise_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, PlacewiseError)
    level = logging.ERROR if error.status >= 500 else logging.DEBUG
    log.log(level, "%s %s: %s", request.method, request.url.path, error.detail)
    return problem_response(error, request)


async def _handle_validation_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    failures = error.errors()
    if any(f["type"] == "json_invalid" or isinstance(f.get("input"), bytes) for f in failures):
        problem: PlacewiseError = InvalidRequest(
            "malformed_body", "The body is not valid JSON with `Content-Type: application/json`."
        )
    else:
        errors = [
            {
                "field": shorten(".".join(map(str, failure["loc"][1:])), MAX_FIELD_CHARACTERS),
                "detail": "is unknown"
                if failure["type"] == "extra_forbidden"
                else failure["msg"].removeprefix("Value error, "),
            }
            for failure in failures[:MAX_REPORTED_ERRORS]
        ]
        detail = "; ".join(f"{e['field'] or 'body'}: {e['detail']}" for e in errors)
        if len(failures) > len(errors):
            detail += f"; and {len(failures) - len(errors)} more errors"
        problem = Unprocessable("invalid_field", detail, errors=errors)
    return problem_response(problem, request)


async def _handle_http_exception(request: Request, error: Exception) -> JSONResponse:
    """Handle Starlette's exceptions, for example of unknown paths and methods."""
    assert isinstance(error, HTTPException)
    if isinstance(error.__cause__, PlacewiseError):  # raised while FastAPI read the body
        return problem_response(error.__cause__, request)
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
    if unavailable is None:  # a bug, which a retry would not fix
        return await handle_unexpected_error(request, error)
    # The driver's reason is for the operator: it names the host and the database.
    log.error("%s %s: %s: %s", request.method, request.url.path, unavailable.code, reason_of(error))
    return problem_response(unavailable, request)


async def _handle_client_disconnect(request: Request, error: Exception) -> Response:
    return Response(status_code=CLIENT_GONE)  # never received; for logs and metrics


async def handle_unexpected_error(request: Request, error: Exception) -> JSONResponse:
    """Convert an unhandled exception into an opaque 500 with the request id, and log it."""
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
        f"An unexpected error occurred. The server's log has its details under the request id "
        f"{request_id}.",
        request_id=request_id,
    )
    return problem_response(problem, request)
