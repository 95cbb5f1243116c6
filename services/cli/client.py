"""Server selection for commands, and waiting for jobs with a progress bar."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import typer
from rich.progress import Progress

from placewise.answers import Generation, Job
from placewise.client import Client, Work
from services.cli import collection_paused
from services.cli.environment import read_settings
from services.cli.output import JsonOption, MapOption, print_note
from shared.config.command_line import command_line
from shared.config.embedded_home import RunningServer, find_running_server
from shared.errors import Misconfigured, Unavailable

START_TIMEOUT_SECONDS = 30.0


@contextlib.contextmanager
def connect(server: str | None, map_name: str | None, key: str | None) -> Iterator[Client]:
    """Connect to a server, starting an embedded one if none runs.

    Args:
        server: URL of the server. By default the server that runs on PLACEWISE_HOME; if none runs
            there, an embedded server is started on a free port and stopped at the end.
        map_name: The map that calls refer to; None for the server's default.
        key: API key. The server on PLACEWISE_HOME stores one there for the local user.

    Raises:
        Misconfigured: `separate_services` if SEARCH_URLS is set and no server is named.
        Unavailable: `server_ended`; `server_unreachable` if the embedded server does not start.
    """
    settings = read_settings()
    find = partial(find_running_server, settings.placewise_home, START_TIMEOUT_SECONDS)
    running_server = RunningServer(server) if server else find()
    if running_server is None:
        if settings.search_worker_urls:
            raise Misconfigured(
                "separate_services",
                "SEARCH_URLS is set, so the command starts no server of its own. Name the gateway: "
                "--server URL, or for example PLACEWISE_SERVER=http://127.0.0.1:8000.",
            )
        print_note(
            f"No server runs on {settings.placewise_home}: starting one for this command. "
            "--server URL or PLACEWISE_HOME selects another."
        )
        with collection_paused():  # clients of a running server don't need it
            from services.standalone import run_standalone
        running_server = find()  # importing takes seconds, in which another command may start one
    if running_server is not None:
        key = key or running_server.key
        with Client(running_server.url, key=key, map=map_name, patience_seconds=0) as client:
            try:
                yield client
            except Unavailable as error:
                if server or error.code != "server_unreachable":
                    raise
                raise Unavailable(
                    "server_ended",
                    f"The server on {settings.placewise_home} has ended, perhaps with the command "
                    "that had started it. Run this command again; `placewise serve` keeps one up.",
                ) from error
        return
    embedded_settings = settings.model_copy(update={"host": "127.0.0.1", "port": 0})
    with run_standalone(embedded_settings, lazy_extractor=True) as running:
        # In a thread: in the main thread, uvicorn would install its own signal handlers.
        serving = threading.Thread(
            target=running.server.run, kwargs={"sockets": [running.listener]}, name="http"
        )
        serving.start()
        try:
            deadline = time.monotonic() + START_TIMEOUT_SECONDS
            while not running.server.started:
                if time.monotonic() > deadline or not serving.is_alive():
                    raise Unavailable(
                        "server_unreachable",
                        "The embedded server did not start within "
                        f"{START_TIMEOUT_SECONDS:.0f} s. Check the log messages above.",
                    )
                time.sleep(0.01)
            key = running.local_key
            with Client(running.url, key=key, map=map_name, patience_seconds=0) as client:
                yield client
        except Exception as error:
            if running.error is not None:  # why the server has stopped
                raise running.error from error
            raise
        finally:
            running.server.should_exit = True
            serving.join()


@dataclass(frozen=True, slots=True)
class ServerOptions:
    """Options of the commands that call a server."""

    server: Annotated[
        str | None,
        typer.Option(
            envvar="PLACEWISE_SERVER",
            help="URL of a Placewise server. Default: the server on PLACEWISE_HOME.",
        ),
    ] = None
    key: Annotated[
        str | None,
        typer.Option(
            envvar="PLACEWISE_KEY",
            help="API key. Prefer the environment variable: other users of this machine can see "
            "command-line options. Not required for the server on PLACEWISE_HOME.",
        ),
    ] = None
    as_json: JsonOption = False

    def connect(self, map_name: str | None = None) -> AbstractContextManager[Client]:
        """Connect as the function `connect` does."""
        return connect(self.server, map_name, self.key)


@dataclass(frozen=True, slots=True)
class MapOptions(ServerOptions):
    """Options of the commands that use a map."""

    map_name: MapOption = None

    def connect(self, map_name: str | None = None) -> AbstractContextManager[Client]:
        """Connect as the function `connect` does, to the map of the option unless one is named."""
        return connect(self.server, map_name or self.map_name, self.key)

    def describe_target(self, client: Client) -> str:
        """Name the map and the server that `connect` has selected."""
        folder = "" if self.server else f", which serves {read_settings().placewise_home}"
        return f"map {self.map_name or 'default'} of {client.url}{folder}"

    def command_line(self, *arguments: str) -> str:
        """Return a command line that works in any folder, for the same server and map."""
        options = ["--map", self.map_name] if self.map_name else []
        if self.server:
            return command_line(*arguments, *options, "--server", self.server)
        return command_line(*arguments, *options, home=read_settings().placewise_home)


POLL_SECONDS = 1.0  # short, so that the progress bar moves


def wait_for_job(client: Client, work: Work, progress: Progress, label: str) -> Job:
    """Wait until a job succeeds, showing its progress in a bar.

    Raises:
        Unprocessable: The job failed or was cancelled; `code` and `detail` are the job's.
    """
    bar = progress.add_task(label, total=None)

    def show(job: Job) -> None:
        progress.update(
            bar,
            description=f"{label}: {job.stage or job.state}",
            completed=job.progress.done,
            total=job.progress.total,
        )

    return client.wait(work, on_progress=show, poll_seconds=POLL_SECONDS)


def active_generation(client: Client) -> Generation | None:
    """The generation that answers searches; None if no photo of the map is described yet."""
    return next((g for g in client.generations() if g.state == "active"), None)
