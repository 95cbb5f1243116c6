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

connect = Client
connect_async = AsyncClient
