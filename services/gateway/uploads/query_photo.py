"""Query photos: received and queued, for a similarity search or a frame of a track."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from uuid import UUID

from fastapi import Request

from services.gateway.admission import AdmissionControl, UploadKind
from services.gateway.dependencies import GatewayContext
from services.gateway.similarity.search_params import SearchParams
from services.gateway.uploads.multipart import FormFile, receive_form_file
from shared.errors import Gone
from shared.ids import new_id
from shared.imaging.photo_header import PhotoHeader
from shared.ingest.validation import check_photo_signature
from shared.jobs import Job, JobKind
from shared.storage.keys import query_key


@contextlib.asynccontextmanager
async def receive_query_photo(
    request: Request, gateway: GatewayContext, admission: AdmissionControl
) -> AsyncIterator[tuple[UUID, FormFile]]:
    """Receive the photo of a request's form; its signature is checked as it arrives.

    Yields the id of its future job, and the file, which the block completes.
    """
    job_id = new_id()
    with admission.admit_upload(UploadKind.QUERY, request):
        async with receive_form_file(
            request,
            gateway.store,
            lambda _filename: query_key(job_id),
            gateway.settings.max_file_size,
            check_photo_signature,
        ) as file:
            yield job_id, file


def describe_query_job(
    job_id: UUID,
    map_id: UUID,
    filename: str,
    search_params: SearchParams,
    header: PhotoHeader,
) -> Job:
    """Create the job of a query photo, which keeps the parameters of its search and its camera."""
    return Job(
        id=job_id,
        map_id=map_id,
        kind=JobKind.DESCRIBE,
        params={
            "filename": filename,
            "search_params": search_params.model_dump(mode="json"),
            "focal_length": header.focal_length,
            "camera_key": header.camera_key,
            "quarter_turns": header.quarter_turns,
        },
    )


def query_job_search_params(job: Job) -> SearchParams:
    """Return the parameters that `describe_query_job` has stored."""
    return SearchParams.model_validate(job.params["search_params"])


def query_expired_error() -> Gone:
    """Return the error for a query whose job has been deleted."""
    return Gone("query_expired", "The query has expired: it is kept for an hour. Send it again.")
