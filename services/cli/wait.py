"""Waiting for a job with a bar."""

from __future__ import annotations

from rich.progress import Progress

from shared.client import Client, Json
from shared.errors import PlacewiseError, Unprocessable

POLL_SECONDS = 1.0  # so that the bar moves


def wait_for_job(client: Client, job_id: str, progress: Progress, label: str) -> Json:
    """The job once it has succeeded; its stored reason as an error when it has not."""
    bar = progress.add_task(label, total=None)

    def show(job: Json) -> None:
        done = job["progress"]
        progress.update(
            bar,
            description=f"{label}: {job['stage'] or job['state']}",
            completed=done["done"],
            total=done["total"],
        )

    job = client.wait_for(job_id, show, poll_seconds=POLL_SECONDS)
    if job["state"] != "succeeded":
        raise _job_error(job)
    return job


def _job_error(job: Json) -> PlacewiseError:
    error = job["error"] or {}
    return Unprocessable(
        error.get("code", "job_ended"), error.get("detail", f"The job is {job['state']}.")
    )
