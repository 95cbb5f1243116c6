"""Doing a step of jobs as what it is: work that someone's request has asked for."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from shared.catalog.jobs import Job
from shared.telemetry.tracing import request_id_context, span


@contextlib.contextmanager
def job_trace_context(jobs: Sequence[Job], step: str) -> Iterator[None]:
    """The block as a span that leads back to the requests of the jobs; where all of them are of one
    request, log lines carry its id, and jobs that are made belong to it."""
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
    """Each once, in the jobs' order; jobs that nobody's request has made add none."""
    return list(dict.fromkeys(job.request_id for job in jobs if job.request_id is not None))
