"""Waiting for a job inside a request: `Prefer: wait=N`, `?wait=N` and the event stream."""

from __future__ import annotations

import asyncio
import re
import time
from uuid import UUID

from fastapi import Request
from starlette.concurrency import run_in_threadpool

from services.gateway.context import Gateway
from shared.jobs import Job
from shared.jobs.table import UNFINISHED

FIRST_LOOK_SECONDS = 0.02
SLOWEST_LOOK_SECONDS = 0.25


def preferred_wait(request: Request, most_seconds: int) -> float:
    """Seconds from `Prefer: wait=N` (RFC 7240), at most `most_seconds`; 0 when not asked."""
    found = re.search(r"(?:^|[,;\s])wait\s*=\s*\"?(\d+)", request.headers.get("prefer", ""))
    return min(float(found[1]), most_seconds) if found else 0.0


def read_job(gateway: Gateway, job_id: UUID) -> Job | None:
    with gateway.catalog.read() as session:
        return session.get(Job, job_id)


async def wait_for_job(gateway: Gateway, job_id: UUID, seconds: float) -> Job | None:
    """The job once it has ended, or as it is when the time is up; None when it is gone."""
    deadline = time.monotonic() + seconds
    pause = FIRST_LOOK_SECONDS
    while True:
        job = await run_in_threadpool(read_job, gateway, job_id)
        left = deadline - time.monotonic()
        if job is None or job.state not in UNFINISHED or left <= 0:
            return job
        await asyncio.sleep(min(pause, left))
        pause = min(pause * 1.5, SLOWEST_LOOK_SECONDS)
