"""Which server a command talks to: the one named, the one on the folder, or one of its own."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

from services.cli.configuration import read_settings
from shared.client import Client
from shared.errors import Unavailable
from shared.home import RunningServer, find_running_server

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
