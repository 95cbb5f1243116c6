"""Waiting for a job inside a request: `Prefer: wait=N`, `?wait=N` and the event stream."""

from __future__ import annotations

import re
from uuid import UUID

from fastapi import Request
from starlette.concurrency import run_in_threadpool

from services.gateway.context import GatewayContext
from shared.jobs import Job


def parse_prefer_wait(request: Request, max_seconds: int) -> float:
    """Seconds from `Prefer: wait=N` (RFC 7240), at most `max_seconds`; 0 when not asked."""
    found = re.search(r"(?:^|[,;\s])wait\s*=\s*\"?(\d+)", request.headers.get("prefer", ""))
    return min(float(found[1]), max_seconds) if found else 0.0


def load_job(gateway: GatewayContext, job_id: UUID) -> Job | None:
    with gateway.catalog.read() as session:
        return session.get(Job, job_id)


async def wait_for_job(gateway: GatewayContext, job_id: UUID, seconds: float) -> Job | None:
    """The job once it has ended, or as it is when the time is up; None when it is gone."""
    await gateway.job_notifier.wait_until_finished(job_id, seconds)
    return await run_in_threadpool(load_job, gateway, job_id)
