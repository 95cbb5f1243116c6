"""The asynchronous client with typed responses.

`client.py` is generated from this file by `make client`. Edit this file.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from uuid import UUID

from placewise.answers import (
    BatchItem,
    BatchStarted,
    Deleted,
    Evaluation,
    Generation,
    Job,
    Map,
    OnePhoto,
    Photo,
    Search,
    Similar,
    Started,
    Stats,
    Uploaded,
    Vocabulary,
)
from shared.client.async_calls import AsyncClient as AsyncRawClient
from shared.client.sending import POLL_SECONDS
from shared.errors import Unavailable, Unprocessable

Id = UUID | str
Work = Uploaded | Started | Job | UUID | str
"""A job: the response that started it, the job itself, or its ID."""


class AsyncClient:
    """Client of one server and one map. `raw` provides the same calls with plain JSON."""

    def __init__(self, raw: AsyncRawClient) -> None:
        self.raw = raw

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Close all connections."""
        await self.raw.aclose()

    async def upload(
        self, photo: str | Path, filename: str | None = None, **fields: Any
    ) -> Uploaded:
        """Upload a photo, streamed from its file.

        Args:
            photo: The file.
            filename: Name to store; None for the file's own name.
            fields: Form fields: `latitude` and `longitude` (degrees), `heading`, `captured_at`,
                `place`, `tags`, `metadata`, `role`.

        Raises:
            Conflict: `photo_differs` if the map contains the same image with other metadata.
            UnsupportedMedia: The file is not a supported image.
            TooLarge: The file exceeds the server's limit.
            Unprocessable: A field or the image is invalid.
        """
        return Uploaded(**await self.raw.upload(Path(photo), filename, **fields))

    async def upload_direct(
        self, photo: str | Path, filename: str | None = None, **fields: Any
    ) -> Uploaded:
        """Upload a photo directly to the server's bucket with a presigned URL.

        The arguments are those of `upload`; `fields` are JSON values.

        Raises:
            Conflict: `no_direct_uploads` if the server stores photos in a folder.
        """
        return Uploaded(**await self.raw.upload_direct(Path(photo), filename, **fields))

    async def upload_archive(
        self, archive: str | Path, on_sent: Callable[[int], object] = lambda sent_bytes: None
    ) -> BatchStarted:
        """Start a batch upload of a zip or tar; `on_sent` receives the bytes sent so far."""
        return BatchStarted(**await self.raw.upload_archive(Path(archive), on_sent))

    async def upload_files(
        self, photos: Sequence[str | Path], manifest: Sequence[dict[str, Any]] = ()
    ) -> BatchStarted:
        """Start a batch upload of photo files.

        Each manifest entry contains a `filename` and fields of `upload`.
        """
        return BatchStarted(**await self.raw.upload_files([Path(p) for p in photos], manifest))

    async def import_objects(self, manifest: Sequence[dict[str, Any]]) -> BatchStarted:
        """Start a batch import of objects in the server's store.

        Each manifest entry contains an object `key` and fields of `upload`.
        """
        return BatchStarted(**await self.raw.import_objects(manifest))

    async def import_prefix(self, prefix: str) -> BatchStarted:
        """Start a batch import of all photos in the server's store below a key prefix."""
        return BatchStarted(**await self.raw.import_prefix(prefix))

    async def batch_items(self, work: Work, *states: str) -> AsyncIterator[BatchItem]:
        """Iterate over the items of a batch, optionally only those in the given states."""
        async for item in self.raw.batch_items(_job_id(work), *states):
            yield BatchItem(**item)

    async def similar(
        self,
        photo: str | Path | Photo | UUID,
        top_k: int = 10,
        min_score: float | None = None,
        rerank: int | None = None,
        explain: bool = False,
        **filters: Any,
    ) -> Similar:
        """Find the most similar photos and estimate the place.

        Args:
            photo: A file, which is not stored, or a stored photo (a Photo or its UUID).
            top_k: Maximum number of results.
            min_score: Minimum cosine similarity.
            rerank: Number of first results to rerank by comparing patches.
            explain: Add explanations to the results.
            filters: `near` ("LAT,LON,RADIUS_M"), `box` ("S,W,N,E"), `captured_after`,
                `captured_before`, `place`, `place_under`, `tags` and `ids` (comma-separated).
                `certainty` is the share of answers that must be right.
        """
        params = {"top_k": top_k, "min_score": min_score, "rerank": rerank, "explain": explain}
        if isinstance(photo, (Photo, UUID)):
            file_id = photo.image_id if isinstance(photo, Photo) else photo
            return Similar(**await self.raw.similar_to(file_id, **{**params, **filters}))
        return Similar(**await self.raw.similar_to_file(Path(photo), **{**params, **filters}))

    async def job(self, work: Work, wait_seconds: float = 0) -> Job:
        """Get a job; with `wait_seconds`, wait that long for it to end (long polling)."""
        return Job(**await self.raw.job(_job_id(work), wait_seconds))

    async def jobs(self, **filters: Any) -> AsyncIterator[Job]:
        """Iterate over the map's jobs, newest first; filters are `state` and `kind`."""
        async for job in self.raw.each("/jobs", "jobs", **filters):
            yield Job(**job)

    async def wait(
        self,
        work: Work,
        timeout_seconds: float | None = None,
        on_progress: Callable[[Job], object] = lambda job: None,
    ) -> Job:
        """Wait until a job succeeds.

        Args:
            work: The job.
            timeout_seconds: Maximum time to wait; None for no limit.
            on_progress: Called with the job after every poll.

        Raises:
            Unprocessable: The job failed (with the job's `code`) or was cancelled (`job_ended`).
            Unavailable: `job_unfinished` if the timeout expires.
        """
        deadline = None if timeout_seconds is None else time.monotonic() + timeout_seconds
        while True:
            remaining = POLL_SECONDS if deadline is None else deadline - time.monotonic()
            job = await self.job(work, max(0.0, min(remaining, POLL_SECONDS)))
            on_progress(job)
            if job.state == "succeeded":
                return job
            if job.finished:
                error = job.error or {}
                detail = error.get("detail", f"The job {job.job_id} is {job.state}.")
                raise Unprocessable(error.get("code", "job_ended"), detail)
            if deadline is not None and time.monotonic() >= deadline:
                raise Unavailable(
                    "job_unfinished",
                    f"The job {job.job_id} is still {job.state} after {timeout_seconds:g} s.",
                )
            if job.waiting_for:
                await asyncio.sleep(1.0)  # the server does not hold long polls of such jobs

    async def cancel(self, work: Work) -> Job:
        """Cancel a job."""
        return Job(**await self.raw.cancel_job(_job_id(work)))

    async def retry(self, work: Work) -> Job:
        """Queue a failed job again; for a batch, its failed items."""
        return Job(**await self.raw.retry_job(_job_id(work)))

    async def photo(self, file_id: Id) -> OnePhoto:
        """Get a stored photo's metadata and state."""
        return OnePhoto(**await self.raw.photo(file_id))

    async def image(self, file_id: Id) -> bytes:
        """Download the original bytes of a photo."""
        return await self.raw.image(file_id)

    async def photos(self, **filters: Any) -> AsyncIterator[Photo]:
        """Iterate over photos by metadata, newest first; for filters see `GET /search`."""
        async for photo in self.raw.each("/search", "images", **filters):
            yield Photo(**photo)

    async def patch_photo(self, file_id: Id, **fields: Any) -> OnePhoto:
        """Update a photo's metadata: omitted fields are unchanged, None clears a field."""
        return OnePhoto(**await self.raw.patch_photo(file_id, **fields))

    async def delete_photo(self, file_id: Id) -> Deleted:
        """Delete a photo."""
        return Deleted(**await self.raw.delete_photo(file_id))

    async def fit_vocabulary(self, **options: int) -> Started:
        """Start fitting a vocabulary on the map's photos.

        Options are `clusters`, `sample` and `seed`.
        """
        return Started(**await self.raw.fit_vocabulary(**options))

    async def import_vocabulary(self, file: str | Path) -> Started:
        """Start reindexing the map with a vocabulary from a `.npz` or `.npy` file."""
        return Started(**await self.raw.import_vocabulary(Path(file)))

    async def vocabularies(self) -> list[Vocabulary]:
        """List the map's vocabularies, newest first."""
        return [Vocabulary(**item) for item in await self.raw.vocabularies()]

    async def start_generation(
        self, *, vocabulary_id: Id | None = None, pca: int | None = None
    ) -> Started:
        """Start reindexing with one of the map's vocabularies or to `pca` dimensions."""
        return Started(**await self.raw.start_generation(vocabulary_id=vocabulary_id, pca=pca))

    async def generations(self) -> list[Generation]:
        """List the map's generations, newest first."""
        return [Generation(**item) for item in await self.raw.generations()]

    async def evaluate(self, **options: int) -> Started:
        """Start an evaluation of the map; options are `sample` and `seed`."""
        return Started(**await self.raw.evaluate(**options))

    async def evaluations(self) -> AsyncIterator[Evaluation]:
        """Iterate over the map's evaluations, newest first."""
        async for evaluation in self.raw.each("/evaluations", "evaluations"):
            yield Evaluation(**evaluation)

    async def searches(self) -> AsyncIterator[Search]:
        """Iterate over the search history, newest first."""
        async for search in self.raw.each("/searches", "searches"):
            yield Search(**search)

    async def maps(self) -> list[Map]:
        """List the maps of the server."""
        return [Map(**item) for item in await self.raw.maps()]

    async def create_map(
        self, name: str, extractor: str | None = None, *, place_labels_are_paths: bool = False
    ) -> Map:
        """Create a map; `extractor` defaults to the server's setting."""
        return Map(
            **await self.raw.create_map(
                name, extractor, place_labels_are_paths=place_labels_are_paths
            )
        )

    async def update_map(self, name: str, *, place_labels_are_paths: bool) -> Map:
        """Change whether `/` separates the levels of the map's place labels."""
        return Map(**await self.raw.update_map(name, place_labels_are_paths=place_labels_are_paths))

    async def delete_map(self, name: str) -> None:
        """Delete a map and all its photos."""
        await self.raw.delete_map(name)

    async def stats(self) -> Stats:
        """Get statistics of the map."""
        return Stats(**await self.raw.stats())


def _job_id(work: Work) -> Id:
    if isinstance(work, (UUID, str)):
        return work
    if work.job_id is None:
        raise Unprocessable(
            "no_job", "This upload has no job: its photo has already been described."
        )
    return work.job_id
