"""Python client of Placewise, a self-hosted visual place recognition service.

    import placewise

    with placewise.connect("http://127.0.0.1:8000") as places:
        places.wait(places.upload("street.jpg", latitude=45.07, longitude=7.69))
        answer = places.similar("where.jpg", top_k=5)
        print(answer.estimate.latitude, answer.similar_images[0].similarity_score)

    async with placewise.connect_async("http://127.0.0.1:8000", key="pw_...", map="lab") as places:
        async for photo in places.photos(place="atrium"):
            ...

Responses are frozen objects of `placewise.answers`. Error responses are raised as subclasses of
PlacewiseError with the attributes `status`, `code` and `detail`.
"""

from placewise.answers import Answer, Job, Photo, Similar
from placewise.async_client import AsyncClient
from placewise.client import Client
from placewise.protocol import TIMEOUT_SECONDS
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
    """Create a client of a server and one of its maps. No request is sent yet.

    Calls are retried with exponential backoff while the server is unavailable (503, 507, no
    connection), and as its Retry-After says while it is busy (429). Every POST carries an
    Idempotency-Key, so that a retried call takes effect once.

    Args:
        url: URL of the server, such as `http://127.0.0.1:8000`.
        key: API key; a server on a loopback address may not require one.
        map: Name of the map; None for `default`.
        patience_seconds: How long calls are retried; 0 disables retries.
        timeout_seconds: Timeout of a single call, in seconds without a byte from the server.

    Raises:
        InvalidRequest: `bad_address`, `bad_key`.
    """
    return Client(url, map, key, patience_seconds=patience_seconds, timeout_seconds=timeout_seconds)


def connect_async(
    url: str,
    *,
    key: str | None = None,
    map: str | None = None,  # noqa: A002
    patience_seconds: float = PATIENCE_SECONDS,
    timeout_seconds: float = TIMEOUT_SECONDS,
) -> AsyncClient:
    """Create an asynchronous client; the parameters are those of `connect`.

    Files to upload are read in the thread of the event loop.
    """
    return AsyncClient(
        url, map, key, patience_seconds=patience_seconds, timeout_seconds=timeout_seconds
    )
