"""Trace and log context of job steps: links the work of a job to the request that queued it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from shared.catalog.jobs import Job
from shared.telemetry.tracing import request_id_context, span


@contextlib.contextmanager
def job_trace_context(jobs: Sequence[Job], step: str) -> Iterator[None]:
    """Run the block in a span that links to the traces of the jobs' requests.

    When all jobs come from one request, log lines carry its id, and jobs that the block creates
    belong to it.
    """
    ids = distinct_request_ids(jobs)
    with (
        request_id_context(ids[0] if len(ids) == 1 else None),
        span(
            step,
            [job.traceparent for job in jobs],
            kind=str(jobs[0].kind),
            jobs=len(jobs),
            job_id=str(jobs[0].id) if len(jobs) == 1 else None,
            request_ids=ids,
        ),
    ):
        yield


def distinct_request_ids(jobs: Sequence[Job]) -> list[str]:
    """Return each request id once, in the jobs' order; a job without a request adds none."""
    return list(dict.fromkeys(job.request_id for job in jobs if job.request_id is not None))
