"""The asynchronous client with typed answers.

`client.py` is made of this file by `make client`: change this one.
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
"""A job: what has started it, itself, or its id."""


class AsyncClient:
    """One server and one map. `raw` has the same calls with the API's own JSON."""

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
        """End the connections."""
        await self.raw.aclose()

    async def upload(
        self, photo: str | Path, filename: str | None = None, **fields: Any
    ) -> Uploaded:
        """Store a photo, streamed from its file. `fields` are the form's: `latitude` and
        `longitude` (degrees), `heading`, `captured_at`, `place`, `tags`, `metadata`, `role`.

        Raises Conflict (`photo_differs`) where the map has these bytes and something else was said
        of them, UnsupportedMedia, TooLarge, Unprocessable.
        """
        return Uploaded(**await self.raw.upload(Path(photo), filename, **fields))

    async def upload_direct(
        self, photo: str | Path, filename: str | None = None, **fields: Any
    ) -> Uploaded:
        """`upload` past the server, straight to its bucket; `fields` as JSON values.

        Raises Conflict (`no_direct_uploads`) where the server keeps photos in a folder.
        """
        return Uploaded(**await self.raw.upload_direct(Path(photo), filename, **fields))

    async def upload_archive(
        self, archive: str | Path, on_sent: Callable[[int], object] = lambda sent_bytes: None
    ) -> BatchStarted:
        """Start a batch with the photos of a zip or tar; `on_sent` sees the bytes sent so far."""
        return BatchStarted(**await self.raw.upload_archive(Path(archive), on_sent))

    async def upload_files(
        self, photos: Sequence[str | Path], manifest: Sequence[dict[str, Any]] = ()
    ) -> BatchStarted:
        """Start a batch with these photos; each line of the manifest has a `filename` and fields
        of `upload`."""
        return BatchStarted(**await self.raw.upload_files([Path(p) for p in photos], manifest))

    async def import_objects(self, manifest: Sequence[dict[str, Any]]) -> BatchStarted:
        """Start a batch with objects of the server's store; each line has a `key` and fields of
        `upload`."""
        return BatchStarted(**await self.raw.import_objects(manifest))

    async def import_prefix(self, prefix: str) -> BatchStarted:
        """Start a batch with every photo of the server's store whose key begins with `prefix`."""
        return BatchStarted(**await self.raw.import_prefix(prefix))

    async def batch_items(self, work: Work, *states: str) -> AsyncIterator[BatchItem]:
        """The photos of a batch that are in one of the states, or all of them."""
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
        """The photos most similar to the one in a file (which is not stored), or to a stored one
        (a Photo, or its UUID): of those that pass the filters `near` ("LAT,LON,RADIUS_M"), `box`
        ("S,W,N,E"), `captured_after`, `captured_before`, `place`, `tags`, `ids` (separated by
        commas). The first `rerank` of them are compared patch by patch.
        """
        wanted = {"top_k": top_k, "min_score": min_score, "rerank": rerank, "explain": explain}
        if isinstance(photo, (Photo, UUID)):
            file_id = photo.image_id if isinstance(photo, Photo) else photo
            return Similar(**await self.raw.similar_to(file_id, **{**wanted, **filters}))
        return Similar(**await self.raw.similar_to_file(Path(photo), **{**wanted, **filters}))

    async def job(self, work: Work, wait_seconds: float = 0) -> Job:
        """The job as it is; the server answers at once when it ends within `wait_seconds`."""
        return Job(**await self.raw.job(_job_id(work), wait_seconds))

    async def jobs(self, **filters: Any) -> AsyncIterator[Job]:
        """The map's jobs, newest first; `state` and `kind` may be given."""
        async for one in self.raw.each("/jobs", "jobs", **filters):
            yield Job(**one)

    async def wait(
        self,
        work: Work,
        timeout_seconds: float | None = None,
        on_progress: Callable[[Job], object] = lambda job: None,
    ) -> Job:
        """The job once it has succeeded; `on_progress` sees it after every poll.

        Raises Unprocessable with the `code` of a job that has failed (`job_ended` where it was
        cancelled), Unavailable (`job_unfinished`) after `timeout_seconds`.
        """
        deadline = None if timeout_seconds is None else time.monotonic() + timeout_seconds
        while True:
            left = POLL_SECONDS if deadline is None else deadline - time.monotonic()
            job = await self.job(work, max(0.0, min(left, POLL_SECONDS)))
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
                await asyncio.sleep(1.0)  # a server that knows so answers at once

    async def cancel(self, work: Work) -> Job:
        return Job(**await self.raw.cancel_job(_job_id(work)))

    async def retry(self, work: Work) -> Job:
        """Queue a failed job again; of a batch, its failed items."""
        return Job(**await self.raw.retry_job(_job_id(work)))

    async def photo(self, file_id: Id) -> OnePhoto:
        return OnePhoto(**await self.raw.photo(file_id))

    async def image(self, file_id: Id) -> bytes:
        """The photo's bytes as they were uploaded."""
        return await self.raw.image(file_id)

    async def photos(self, **filters: Any) -> AsyncIterator[Photo]:
        """Photos by what is known of them, newest first; see `GET /search`."""
        async for one in self.raw.each("/search", "images", **filters):
            yield Photo(**one)

    async def patch_photo(self, file_id: Id, **fields: Any) -> OnePhoto:
        """Change what is said of a photo: what is left out stays, None clears."""
        return OnePhoto(**await self.raw.patch_photo(file_id, **fields))

    async def delete_photo(self, file_id: Id) -> Deleted:
        return Deleted(**await self.raw.delete_photo(file_id))

    async def fit_vocabulary(self, **wanted: int) -> Started:
        """Learn a vocabulary from the map's photos; `clusters`, `sample`, `seed` may be given."""
        return Started(**await self.raw.fit_vocabulary(**wanted))

    async def import_vocabulary(self, file: str | Path) -> Started:
        """Switch to the vocabulary in a `.npz` or `.npy` file."""
        return Started(**await self.raw.import_vocabulary(Path(file)))

    async def vocabularies(self) -> list[Vocabulary]:
        return [Vocabulary(**one) for one in await self.raw.vocabularies()]

    async def start_generation(
        self, *, vocabulary_id: Id | None = None, pca: int | None = None
    ) -> Started:
        """Switch to a vocabulary that the map has, or to descriptors of `pca` dimensions."""
        return Started(**await self.raw.start_generation(vocabulary_id=vocabulary_id, pca=pca))

    async def generations(self) -> list[Generation]:
        """The map's generations, newest first."""
        return [Generation(**one) for one in await self.raw.generations()]

    async def evaluate(self, **wanted: int) -> Started:
        """Measure the map; `sample` and `seed` may be given."""
        return Started(**await self.raw.evaluate(**wanted))

    async def evaluations(self) -> AsyncIterator[Evaluation]:
        """Newest first."""
        async for one in self.raw.each("/evaluations", "evaluations"):
            yield Evaluation(**one)

    async def searches(self) -> AsyncIterator[Search]:
        """What was asked, newest first."""
        async for one in self.raw.each("/searches", "searches"):
            yield Search(**one)

    async def maps(self) -> list[Map]:
        """Every map of the server."""
        return [Map(**one) for one in await self.raw.maps()]

    async def create_map(self, name: str, extractor: str | None = None) -> Map:
        return Map(**await self.raw.create_map(name, extractor))

    async def delete_map(self, name: str) -> None:
        """Delete a map with all its photos."""
        await self.raw.delete_map(name)

    async def stats(self) -> Stats:
        return Stats(**await self.raw.stats())


def _job_id(work: Work) -> Id:
    if isinstance(work, (UUID, str)):
        return work
    if work.job_id is None:
        raise Unprocessable("no_job", "This upload has no job: its photo is described already.")
    return work.job_id
