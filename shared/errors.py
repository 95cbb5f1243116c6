"""Every error that a caller can meet, with its HTTP status and its stable code.

PlacewiseError
├── InvalidRequest 400          no_file, empty_file, malformed_body, bad_manifest, ...
├── Unauthorized 401            key_missing, key_unknown, key_revoked, key_expired
├── Forbidden 403               scope_missing, foreign_page, forwarded_request
├── NotFound 404                photo_not_found, job_not_found, map_not_found, ...
├── RequestTimeout 408          request_too_slow
├── Conflict 409                not_searchable, coordinates_differ, model_change_running, ...
├── Gone 410                    query_expired
├── LengthRequired 411          length_required
├── TooLarge 413                file_too_large, batch_too_large, ...
├── UnsupportedMedia 415        unsupported_photo, unsupported_body, unsupported_archive
├── Unprocessable 422           invalid_field, undecodable_photo, too_many_pixels, ...
├── TooManyRequests 429         queue_full, too_many_requests, ... (come again after `Retry-After`)
├── Unavailable 503             search_behind, codes_being_made, ... (may be tried again)
│   │                       object_store_unavailable, catalog_damaged, ...
│   └── StorageFull 507         disk_full, object_store_full
└── Misconfigured 500           weights_missing, no_gpu, ... (an operator must act)

`shared.errors` knows nothing of HTTP libraries: the gateway turns these into RFC 9457 problems,
the extractor stores them in `jobs.error`, the command line prints `detail`.
"""

from __future__ import annotations

import json
from typing import Any, ClassVar


class PlacewiseError(Exception):
    """Something that can be explained to whoever asked.

    `detail` says what is wrong with which thing and what to do next. `extra` holds members that a
    program can read (they become extension members of the problem document). One of them,
    `retry_after_seconds`, becomes the header `Retry-After` as well.
    """

    status: ClassVar[int] = 500
    title: ClassVar[str] = "Placewise could not do this"

    def __init__(self, code: str, detail: str, **extra: Any) -> None:
        super().__init__(detail)
        self.code = code
        self.detail = detail
        self.extra = extra

    def __reduce__(self) -> tuple[Any, ...]:
        # Keyword arguments don't survive the default pickling, and errors cross processes.
        return _unpickle_error, (type(self), self.code, self.detail, self.extra)

    def as_problem(self) -> dict[str, Any]:
        """The RFC 9457 members, without `instance`."""
        return {
            "type": f"urn:placewise:problem:{self.code}",
            "title": self.title,
            "status": self.status,
            "detail": self.detail,
            "code": self.code,
            **self.extra,
        }


def _unpickle_error(
    kind: type[PlacewiseError], code: str, detail: str, extra: dict[str, Any]
) -> PlacewiseError:
    return kind(code, detail, **extra)


class InvalidRequest(PlacewiseError):
    status = 400
    title = "The request can't be read"


class Unauthorized(PlacewiseError):
    """The gateway adds `WWW-Authenticate`."""

    status = 401
    title = "A key is needed"


class Forbidden(PlacewiseError):
    status = 403
    title = "This caller may not do that"


class NotFound(PlacewiseError):
    status = 404
    title = "Not found"


class RequestTimeout(PlacewiseError):
    """The request came too slowly; nothing was done. The connection is closed."""

    status = 408
    title = "The request came too slowly"


class Conflict(PlacewiseError):
    status = 409
    title = "Not possible in the present state"


class Gone(PlacewiseError):
    status = 410
    title = "No longer kept"


class LengthRequired(PlacewiseError):
    status = 411
    title = "The length must be said"


class TooLarge(PlacewiseError):
    status = 413
    title = "Too large"


class UnsupportedMedia(PlacewiseError):
    status = 415
    title = "Not a supported format"


class Unprocessable(PlacewiseError):
    status = 422
    title = "The content can't be used"


class TooManyRequests(PlacewiseError):
    """Nothing was done; the same call is welcome after `retry_after_seconds`, which it needs."""

    status = 429
    title = "Too much at once"


class Unavailable(PlacewiseError):
    """The same call may work a little later: the gateway adds `Retry-After`."""

    status = 503
    title = "Not available right now"


class StorageFull(Unavailable):
    """No room for more bytes until someone makes some; nothing was stored."""

    status = 507
    title = "No room left"


class Misconfigured(PlacewiseError):
    title = "The installation needs attention"


def invalid_field_error(field: str, detail: str) -> Unprocessable:
    """The 422 for one value that is out of range or can't be read; it names the field."""
    return Unprocessable(
        "invalid_field",
        f"{field}: {detail}",
        errors=[{"field": field, "detail": detail}],
    )


_ERRORS_BY_STATUS: dict[int, type[PlacewiseError]] = {
    kind.status: kind
    for kind in (
        InvalidRequest,
        Unauthorized,
        Forbidden,
        NotFound,
        RequestTimeout,
        Conflict,
        Gone,
        LengthRequired,
        TooLarge,
        UnsupportedMedia,
        Unprocessable,
        TooManyRequests,
        Unavailable,
        StorageFull,
    )
}


_PROXY_ERRORS_BY_STATUS: dict[int, type[PlacewiseError]] = {
    429: TooManyRequests,
    **dict.fromkeys((502, 503, 504, 507), Unavailable),
}


def error_from_response(status: int, body: str) -> PlacewiseError:
    """The error that a server answered with, made from its problem document.

    A code of `bad_answer` for whatever is no problem document: a proxy's page, say. Of the proxy's
    word that the server is away or busy, too, the kind of error is what it means.
    """
    try:
        problem: dict[str, Any] = json.loads(body)
        code, detail = problem.pop("code"), problem.pop("detail")
    except (ValueError, KeyError, TypeError, AttributeError):
        kind = _PROXY_ERRORS_BY_STATUS.get(status, PlacewiseError)
        return kind("bad_answer", f"HTTP {status}: {body[:200]}")
    for member in ("type", "title", "status", "instance"):
        problem.pop(member, None)
    return _ERRORS_BY_STATUS.get(status, PlacewiseError)(code, detail, **problem)
