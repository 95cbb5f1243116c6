"""Builds responses of the API from rows of the catalog, the URLs in them, and archives."""

from __future__ import annotations

import tarfile
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from typing import Any, Self, TypeVar
from urllib.parse import urlencode
from uuid import UUID

from fastapi.responses import JSONResponse, StreamingResponse
from pydantic import Field

from services.gateway.dependencies import API_PREFIX
from shared.catalog.jobs import JOB_TYPES
from shared.catalog.maps import DEFAULT_MAP
from shared.catalog.photos import Photo
from shared.jobs import Job, JobKind, JobState
from shared.responses import ResponseModel
from shared.responses.jobs import JobAccepted, JobFields, JobProgress
from shared.responses.similarity import GivenPlace, PhotoResponse

P = TypeVar("P", bound=PhotoResponse)


def photo_response(kind: type[P], photo: Photo, map_name: str, **values: Any) -> P:
    """Build a response about a photo; `values` are the fields that subclasses add."""
    image, thumbnail, preview = (
        url_in_map(f"/uploads/{photo.id}/{name}", map_name)
        for name in ("image", "thumbnail", "preview")
    )
    return kind.of_row(
        photo,
        image_path=image,
        image_url=image,
        thumbnail_url=thumbnail,
        preview_url=preview,
        given_place=GivenPlace.model_validate(photo.given_place)
        if photo.given_place and photo.place_is_as_given
        else None,
        **values,
    )


class MetadataSearchResponse(ResponseModel):
    total_found: int = Field(
        description="number of all matches, not only of this page; at most 10,000"
    )
    total_is_exact: bool = Field(description="false: there may be more than `total_found`")
    images: list[PhotoResponse]
    next_cursor: str | None
    query_time_ms: float


class JobResponse(JobFields):
    kind: JobKind

    @classmethod
    def of(cls, job: Job, map_name: str, filename: str | None) -> JobResponse:
        """Build the response; `filename` is that of its photo or uploaded file, if it has one."""
        is_query = job.kind == JobKind.DESCRIBE
        return cls.of_row(
            job,
            label=JOB_TYPES[JobKind(job.kind)].title,
            progress=JobProgress.model_validate(job),
            map=map_name,
            filename=filename,
            result=None if is_query else job.result,
            status_url=job_url(job.id, map_name),
            result_url=job_url(job.id, map_name, "/result") if is_query else None,
        )


class JobsResponse(ResponseModel):
    jobs: list[JobResponse]
    next_cursor: str | None


class JobAcceptedResponse(JobAccepted):
    """202: the job is queued; poll `status_url`."""

    @classmethod
    def of(cls, job: Job, map_name: str, **values: Any) -> Self:
        """Build the response; `values` are the fields that subclasses add."""
        result_url = job_url(job.id, map_name, "/result") if job.kind == JobKind.DESCRIBE else None
        return cls(
            job_id=job.id,
            status=JobState(job.state),
            status_url=job_url(job.id, map_name),
            result_url=result_url,
            **values,
        )

    @property
    def headers(self) -> dict[str, str]:
        """Headers of the response."""
        return accepted_headers(self.status_url)

    def to_http(self, headers: Mapping[str, str] | None = None) -> JSONResponse:
        """Return the HTTP response, for routes whose response model is that of another status."""
        return JSONResponse(self.model_dump(mode="json"), 202, {**(headers or {}), **self.headers})


def url_in_map(path: str, map_name: str) -> str:
    """Return the URL path of an endpoint, with `?map=` unless the map is the default one."""
    return f"{API_PREFIX}{path}" + (
        "" if map_name == DEFAULT_MAP else f"?{urlencode({'map': map_name})}"
    )


def job_url(job_id: UUID, map_name: str, suffix: str = "") -> str:
    """Return the URL path of a job, or of one of its subresources such as `/result`."""
    return url_in_map(f"/jobs/{job_id}{suffix}", map_name)


def accepted_headers(status_url: str) -> dict[str, str]:
    """Build the headers of a 202 response."""
    return {"Location": status_url, "Retry-After": "1"}


def describe_tar(content: str) -> dict[int | str, dict[str, Any]]:
    """Describe the response with a tar archive in the API's schema."""
    media = {"application/x-tar": {"schema": {"type": "string", "format": "binary"}}}
    return {200: {"content": media, "description": content}}


def tar_response(
    name: str, made_at: datetime, members: Iterable[tuple[str, int, Iterable[bytes]]]
) -> StreamingResponse:
    """Stream a tar archive of files: name, size in bytes, and content."""

    def stream() -> Iterator[bytes]:
        for member, size_bytes, content in members:
            entry = tarfile.TarInfo(member)
            entry.size, entry.mtime = size_bytes, int(made_at.timestamp())
            yield entry.tobuf(tarfile.GNU_FORMAT)
            yield from content
            yield bytes(-size_bytes % tarfile.BLOCKSIZE)
        yield bytes(2 * tarfile.BLOCKSIZE)

    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return StreamingResponse(stream(), media_type="application/x-tar", headers=headers)
