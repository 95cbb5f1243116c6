"""Settings of the job queue: leases, retries, retention; and of automatic evaluation."""

from __future__ import annotations

from pydantic import Field
from pydantic_settings import BaseSettings


class JobSettings(BaseSettings):
    """Leases and retries of jobs, retention of finished ones, automatic evaluation."""

    lease_seconds: float = Field(
        60.0,
        gt=0,
        description="time without a renewal after which a job's lease expires, seconds",
    )
    drain_seconds: float = Field(
        10.0, gt=0, description="time that a worker spends on jobs for one notification, seconds"
    )
    visibility_seconds: int = Field(
        900,
        ge=60,
        description="Redis visibility timeout: an unacknowledged notification is delivered again "
        "after this time, seconds",
    )
    max_attempts: int = Field(
        3, ge=1, description="crashes of a job that runs alone before it is failed"
    )
    query_ttl_seconds: float = Field(
        3600.0, gt=0, description="retention of a query photo that is not stored, seconds"
    )
    job_retention_days: float = Field(
        30.0,
        gt=0,
        description="retention of a finished job, days; photos that were not described keep theirs",
    )
    search_history_days: float = Field(
        90.0, gt=0, description="retention of a search in the history, days"
    )
    track_retention_days: float = Field(
        30.0, gt=0, description="retention of a track after its last frame, days"
    )
    auto_evaluate_photos: int = Field(
        20,
        ge=0,
        description="geotagged photos from which a changed map is evaluated automatically; "
        "0: never",
    )
