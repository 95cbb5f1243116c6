"""Which server a command talks to: the one named, the one on the folder, or one of its own.

Waiting for a job with a bar.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

from rich.progress import Progress

from services.cli.environment import read_settings
from shared.client import Client, Json
from shared.config.embedded_home import RunningServer, find_running_server
from shared.errors import PlacewiseError, Unavailable, Unprocessable

START_TIMEOUT_SECONDS = 30.0


@contextlib.contextmanager
def connect(server: str | None, map_name: str | None, key: str | None = None) -> Iterator[Client]:
    """A client of `server`, else of the server on PLACEWISE_HOME, else of one started for it.

    `key` is what `server` wants. The server on PLACEWISE_HOME leaves one there for its own user.
    """
    settings = read_settings()
    found = RunningServer(server) if server else find_running_server(settings.placewise_home)
    if found is not None:
        with Client(found.url, map_name, key or found.key) as client:
            yield client
        return
    # Imported only here: torch takes seconds, and a client of a running server needs none of it.
    from services.standalone import run_standalone

    own = settings.model_copy(update={"host": "127.0.0.1", "port": 0})
    with run_standalone(own) as running:
        # Not the main thread: uvicorn would take over the command's signals there.
        serving = threading.Thread(target=running.serve, name="http")
        serving.start()
        try:
            deadline = time.monotonic() + START_TIMEOUT_SECONDS
            while not running.server.started:
                if time.monotonic() > deadline or not serving.is_alive():
                    raise Unavailable("server_unreachable", "The embedded server did not start.")
                time.sleep(0.01)
            with Client(running.url, map_name, running.local_key) as client:
                yield client
        finally:
            running.server.should_exit = True
            serving.join()


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
