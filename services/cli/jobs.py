"""`placewise jobs`: list the jobs of a map with their files, and retry failed ones."""

from __future__ import annotations

from itertools import islice
from typing import Annotated

import typer

from placewise.answers import Job
from placewise.client import Client
from services.cli.client import MapOptions
from services.cli.output import Table, print_note, print_result
from shared.errors import Conflict


def jobs(
    common: MapOptions,
    failed: Annotated[
        bool, typer.Option("--failed", help="Only failed jobs, with the reason.")
    ] = False,
    retry: Annotated[
        bool, typer.Option("--retry", help="Queue the failed jobs of the list again.")
    ] = False,
    limit: Annotated[int, typer.Option(min=1, help="Number of jobs, the newest first.")] = 50,
) -> None:
    """List the jobs of a map, newest first, with the file and the reason of a failure."""
    filters = {"state": ["failed"]} if failed or retry else {}
    with common.connect() as client:
        found = list(islice(client.jobs(**filters), limit))
        if retry:
            found = [_retry(client, job) for job in found]
    table = Table("state", "file", "job", "created", "reason")
    for job in found:
        created = job.created_at.strftime("%Y-%m-%d %H:%M")
        reason = job.failure if job.error else job.waiting_for or ""
        table.add_row(job.state, job.filename or "", job.kind, created, reason)
    print_result(found, common.as_json, table)


def _retry(client: Client, job: Job) -> Job:
    """Queue the job again; return it unchanged, with a note, if it can't be retried."""
    try:
        return client.retry(job)
    except Conflict as error:
        print_note(f"{job.filename or job.job_id}: {error.detail}")
        return job
