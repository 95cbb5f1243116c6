"""Responses about jobs and uploads."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from pydantic import Field

from shared.enums import JobState
from shared.responses import OPEN, ResponseModel


class JobProgress(ResponseModel):
    done: int = Field(validation_alias="progress_done")
    total: int = Field(validation_alias="progress_total")
    failed: int = Field(validation_alias="progress_failed")


class JobFields(ResponseModel):
    job_id: UUID = Field(validation_alias="id")
    kind: str
    label: str = Field(description="the kind in plain words, such as `Improving the map`")
    state: Annotated[JobState, OPEN]
    stage: str | None = Field(
        description="model changes: `sample`, `cluster`, `describe`, `load`; batches: `list`, "
        "`store`, `describe`"
    )
    waiting_for: str | None = Field(
        description="what must become available before the job can continue: `descriptors`, "
        "`search`, or for batches `disk_space`"
    )
    awaited: list[str] | None = Field(
        description="search workers that the job has been waiting for longer than a minute"
    )
    progress: JobProgress
    attempts: int
    map: str
    file_id: UUID | None = Field(validation_alias="photo_id")
    filename: str | None = Field(
        description="name of the photo, or of the uploaded vocabulary or checkpoint"
    )
    result: dict[str, Any] | None
    error: dict[str, Any] | None = Field(description="an RFC 9457 problem")
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    status_url: str
    result_url: str | None
    request_id: str | None = Field(
        description="`X-Request-ID` of the request that created the job, as in the logs"
    )


class JobAccepted(ResponseModel):
    """A job that was queued."""

    job_id: UUID
    status: Annotated[JobState, OPEN]
    status_url: str
    result_url: str | None = None


class BatchItemResponse(ResponseModel):
    number: int = Field(description="from 1, in upload order")
    name: str
    state: Annotated[JobState, OPEN] = Field(description="`succeeded`: searchable")
    file_id: UUID | None = Field(validation_alias="photo_id")
    job_id: UUID | None = Field(
        validation_alias="photo_job_id", description="the job that describes the photo"
    )
    already_there: bool = Field(description="the map already had these bytes; nothing was stored")
    line: int | None = Field(description="line of the photo in the manifest, if any")
    error: dict[str, Any] | None = Field(description="an RFC 9457 problem")


class UploadResponse(ResponseModel):
    file_id: UUID
    job_id: UUID | None
    filename: str
    file_size: int
    upload_time: datetime
    status: Annotated[JobState, OPEN]
    status_url: str
    already_there: bool = Field(description="the map already has this picture; no photo was added")
    updated: list[str] = Field(
        description="values of the map's photo that new metadata of its file has set"
    )
    message: str


class DeletedPhotoResponse(ResponseModel):
    success: bool
    message: str
    deleted_file_id: UUID
