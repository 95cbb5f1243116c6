"""The exceptions of Placewise, each with an HTTP status and a stable error code.

PlacewiseError
├── InvalidRequest 400          no_file, empty_file, malformed_body, bad_manifest, ...
├── Unauthorized 401            key_missing, key_unknown, key_revoked, key_expired,
│                                proxy_user_invalid
├── Forbidden 403               scope_missing, map_not_allowed, foreign_page,
│                                forwarded_request
├── NotFound 404                photo_not_found, job_not_found, map_not_found, ...
├── RequestTimeout 408          request_too_slow
├── Conflict 409                not_searchable, photo_differs, model_change_running, ...
├── Gone 410                    query_expired
├── TooLarge 413                file_too_large, batch_too_large, ...
├── UnsupportedMedia 415        unsupported_photo, unsupported_body
├── Unprocessable 422           invalid_field, undecodable_photo, too_many_pixels, ...
├── TooManyRequests 429         queue_full, too_many_requests, ... (retry after `Retry-After`)
├── Unavailable 503             search_behind, catalog_busy, ... (transient, retryable)
│   │                       object_store_unavailable, catalog_damaged, ...
│   └── StorageFull 507         disk_full, object_store_full
└── Misconfigured 500           weights_missing, no_gpu, ... (an operator must act)

`shared.errors` imports no HTTP library: the gateway converts these exceptions into RFC 9457
problem documents, the extractor stores them in `jobs.error`, the command line prints `detail`.
"""

from __future__ import annotations

import json
from typing import Any, ClassVar


class PlacewiseError(Exception):
    """Base class of the errors that are reported to the caller.

    Attributes:
        code: stable identifier for programs.
        detail: message for people: what happened, which value, what to do.
        extra: extension members of the problem document. `retry_after_seconds` also becomes the
            header `Retry-After`.
    """

    status: ClassVar[int] = 500
    title: ClassVar[str] = "The operation failed"

    def __init__(self, code: str, detail: str, **extra: Any) -> None:
        super().__init__(detail)
        self.code = code
        self.detail = detail
        self.extra = extra

    def __reduce__(self) -> tuple[Any, ...]:
        # The default pickling loses keyword arguments, and errors are sent between processes.
        return _unpickle_error, (type(self), self.code, self.detail, self.extra)

    def as_problem(self) -> dict[str, Any]:
        """Return the members of the RFC 9457 problem document, without `instance`."""
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
    """Authentication failed; the gateway adds `WWW-Authenticate`."""

    status = 401
    title = "A key is needed"


class Forbidden(PlacewiseError):
    status = 403
    title = "This caller may not do that"


class NotFound(PlacewiseError):
    status = 404
    title = "Not found"


class RequestTimeout(PlacewiseError):
    """The request arrived too slowly. It had no effect, and the connection is closed."""

    status = 408
    title = "The request arrived too slowly"


class Conflict(PlacewiseError):
    status = 409
    title = "Conflict with the current state"


class Gone(PlacewiseError):
    status = 410
    title = "No longer available"


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
    """Rate limit, quota or backpressure. The request had no effect; `retry_after_seconds` is
    required."""

    status = 429
    title = "Too many requests"


class Unavailable(PlacewiseError):
    """A transient failure: the same request may succeed later. The gateway adds `Retry-After`."""

    status = 503
    title = "Not available right now"


class StorageFull(Unavailable):
    """The disk or the object store is full; nothing was stored."""

    status = 507
    title = "The storage is full"


class Misconfigured(PlacewiseError):
    """The installation or its settings need an operator."""

    title = "The installation needs attention"


def shorten(text: str, characters: int) -> str:
    """Cut what the caller sent down to what an error repeats of it."""
    return text if len(text) <= characters else f"{text[:characters]}..."


def invalid_field_error(field: str, detail: str) -> Unprocessable:
    """Return the 422 for one field whose value is out of range or can't be parsed."""
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
    """Convert an HTTP error response into the exception that its problem document describes.

    A body that is not a problem document, for example a proxy's error page, gives the code
    `bad_answer`; the exception class then follows from the status for 429, 502, 503, 504 and 507.
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
