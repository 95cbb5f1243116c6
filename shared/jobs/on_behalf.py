"""Doing a step of jobs as what it is: work that someone's request has asked for."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from shared.jobs.table import Job
from shared.telemetry.request_id import under_request_id
from shared.telemetry.traces import span


@contextlib.contextmanager
def on_behalf_of(jobs: Sequence[Job], step: str) -> Iterator[None]:
    """The block as a span that leads back to the requests of the jobs; where all of them are of one
    request, log lines carry its id, and jobs that are made belong to it."""
    ids = request_ids(jobs)
    with (
        under_request_id(ids[0] if len(ids) == 1 else None),
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


def request_ids(jobs: Sequence[Job]) -> list[str]:
    """Each once, in the jobs' order; jobs that nobody's request has made add none."""
    return list(dict.fromkeys(job.request_id for job in jobs if job.request_id is not None))
