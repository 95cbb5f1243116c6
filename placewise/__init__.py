"""The Python client of Placewise: photo in, place out.

    import placewise

    with placewise.connect("http://127.0.0.1:8000") as places:
        places.wait(places.upload("street.jpg", latitude=45.07, longitude=7.69))
        answer = places.similar("where.jpg", top_k=5)
        print(answer.estimate.latitude, answer.similar_images[0].similarity_score)

    async with placewise.connect_async("http://127.0.0.1:8000", key="pw_...", map="lab") as places:
        async for photo in places.photos(place="atrium"):
            ...

Answers are the frozen objects of `placewise.answers`. Whatever the server refuses is raised as the
error that it means, a PlacewiseError with its `status`, `code` and `detail`.
"""

from placewise.answers import Answer, Job, Photo, Similar
from placewise.async_client import AsyncClient
from placewise.client import Client
from shared.client.async_calls import AsyncClient as _AsyncRaw
from shared.client.calls import Client as _Raw
from shared.client.sending import TIMEOUT_SECONDS
from shared.errors import (
    Conflict,
    Forbidden,
    Gone,
    InvalidRequest,
    NotFound,
    PlacewiseError,
    RequestTimeout,
    StorageFull,
    TooLarge,
    TooManyRequests,
    Unauthorized,
    Unavailable,
    Unprocessable,
    UnsupportedMedia,
)

PATIENCE_SECONDS = 60.0

__all__ = [
    "Answer",
    "AsyncClient",
    "Client",
    "Conflict",
    "Forbidden",
    "Gone",
    "InvalidRequest",
    "Job",
    "NotFound",
    "Photo",
    "PlacewiseError",
    "RequestTimeout",
    "Similar",
    "StorageFull",
    "TooLarge",
    "TooManyRequests",
    "Unauthorized",
    "Unavailable",
    "Unprocessable",
    "UnsupportedMedia",
    "connect",
    "connect_async",
]


def connect(
    url: str,
    *,
    key: str | None = None,
    map: str | None = None,  # noqa: A002
    patience_seconds: float = PATIENCE_SECONDS,
    timeout_seconds: float = TIMEOUT_SECONDS,
) -> Client:
    """A client of the server at `url` and of one of its maps (left out: `default`).

    A call that meets a server which is away (503, 507, no connection) is repeated for
    `patience_seconds`, after waits that double; one that says when to come again is obeyed. Every
    POST has an Idempotency-Key, so that what is repeated is done once. 0 repeats nothing. A call
    ends after `timeout_seconds` without a byte. Nothing is asked of the server yet.

    Raises InvalidRequest (`bad_address`, `bad_key`).
    """
    return Client(
        _Raw(url, map, key, patience_seconds=patience_seconds, timeout_seconds=timeout_seconds)
    )


def connect_async(
    url: str,
    *,
    key: str | None = None,
    map: str | None = None,  # noqa: A002
    patience_seconds: float = PATIENCE_SECONDS,
    timeout_seconds: float = TIMEOUT_SECONDS,
) -> AsyncClient:
    """`connect`, for asyncio. Photos are read from disk between two sends, in the loop's thread."""
    return AsyncClient(
        _AsyncRaw(url, map, key, patience_seconds=patience_seconds, timeout_seconds=timeout_seconds)
    )
