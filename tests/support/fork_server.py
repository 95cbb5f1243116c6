"""The fork server behind tests/support/processes.py: `python -m` it with the number of a socket.

It imports what the `placewise` command imports, once, and then is forked for each start: a start
costs a fork instead of seconds of imports. All test processes of a run are its clients. It serves
one request at a time and has no threads, as a fork would copy the locks that they hold.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import json
import os
import runpy
import selectors
import signal
import socket
import sys
import threading
from pathlib import Path
from typing import Any, cast

from sqlalchemy.orm import configure_mappers

import services.cli
from services.cli import collection_paused
from services.search.sign_code_search import compile_kernels
from shared.config.settings import Settings
from tests.support.shared_tls import share_tls_context
from tools.make_api_page import openapi_description

# Beside the command's own modules: what they import when they run. A module that is missing here is
# imported by each process that needs it.
MODULES = (
    "lab.cli.descriptors.describe_files",
    "services.extractor.service",
    "services.gateway.app",
    "services.search.service",
    "services.standalone",
    "services.steward.batches.worker",
    "services.steward.evaluation_worker",
    "services.steward.scheduler",
    "lab.training.run",
    "shared.jobs.celery_messages",
    "shared.storage.open_store",
    "shared.descriptors.extractor",
    "shared.descriptors.vocabulary_file",
    # What is imported at its first use.
    "alembic.command",
    "shared.catalog.database.postgres",
    "shared.storage.s3",
    "PIL.JpegImagePlugin",
    "kornia.feature",
    "anyio._backends._asyncio",
    "httpcore2",
    "numpy.random",
    "uvicorn.lifespan.on",
    "uvicorn.loops.auto",
    "uvicorn.protocols.http.h11_impl",
    # What tests import.
    "hypothesis",
    "pycolmap",
    "schemathesis",
)
REQUEST_BYTES = 128 * 1024  # an environment has a few KiB


def serve(listener: socket.socket) -> dict[str, Any] | None:
    """Answer until the last client has gone. In a child: what it is to run."""
    clients: dict[socket.socket, dict[int, int | None]] = {}  # with the exit codes of its processes
    with selectors.DefaultSelector() as selector:
        selector.register(listener, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                ready = cast(socket.socket, key.fileobj)
                if ready is listener:
                    client, _ = listener.accept()
                    clients[client] = {}
                    selector.register(client, selectors.EVENT_READ)
                    continue
                try:
                    request = _answer(ready, clients[ready])
                except EOFError:  # its tests have ended, in good order or not
                    selector.unregister(ready)
                    ready.close()
                    _kill(clients.pop(ready))
                    if not clients:
                        return None
                else:
                    if request is not None:
                        for inherited in (listener, *clients):
                            inherited.close()
                        return request


def _answer(client: socket.socket, codes: dict[int, int | None]) -> dict[str, Any] | None:
    """Answer a request; `codes` are None for processes that run. In a child: what it is to run."""
    message, given, _, _ = socket.recv_fds(client, REQUEST_BYTES, maxfds=3)
    if not message:
        raise EOFError
    request: dict[str, Any] = json.loads(message)
    if "ended" in request:
        pid = request["ended"]
        if codes[pid] is None:
            codes[pid] = _exit_code(pid)
        answer = codes[pid]
    elif "command" not in request:
        answer = None  # it is ready
    else:
        answer = os.fork()
        for standard, descriptor in enumerate(given):
            if answer == 0:
                os.dup2(descriptor, standard)
            os.close(descriptor)
        if answer == 0:
            return request
        codes[answer] = None
    client.send(json.dumps([request["number"], answer]).encode())
    return None


def _kill(codes: dict[int, int | None]) -> None:
    for pid, code in codes.items():
        if code is None:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def run(request: dict[str, Any]) -> None:
    """Run the command in this process, and end it without taking down what was imported.

    Freeing the imported modules would copy their pages: 0.5 s of CPU for each process. The
    interpreter handles what else the program raises.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    program, *_ = sys.argv = request["command"]
    sys.path[0] = str(Path(program).parent)
    # As the interpreter does it: spawned children look for the program in sys.modules["__main__"].
    code = 0
    try:
        runpy.run_path(program, run_name="__main__")
    except SystemExit as ended:
        if not isinstance(ended.code, int | None):
            raise
        code = ended.code or 0
    threading._shutdown()  # type: ignore[attr-defined]  # waits for threads, as the interpreter does
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _exit_code(pid: int) -> int | None:
    """As subprocess gives it; None while the process runs."""
    ended, status = os.waitpid(pid, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if ended else None


def _import() -> None:
    entry_point = services.cli.main
    importlib.import_module("services.cli.main").build_app()
    for module in MODULES:
        importlib.import_module(module)
    services.cli.main = entry_point  # the submodule of the same name has taken its place
    # What each process would work out for itself at its first use of them.
    Settings()
    configure_mappers()
    openapi_description()  # works out all routes
    compile_kernels()
    share_tls_context()


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the tests, which then end this
    atexit.register(gc.unfreeze)  # or triton would hide an error behind hundreds of "leaks"
    listener = socket.socket(fileno=int(sys.argv[1]))
    with collection_paused():  # which leaves these pages shared with the children's collections
        _import()
    assert threading.active_count() == 1, threading.enumerate()
    tasks = list(Path("/proc/self/task").iterdir())
    assert len(tasks) == 1, [task.joinpath("comm").read_text() for task in tasks]
    request = serve(listener)
    if request is not None:
        run(request)


if __name__ == "__main__":
    main()
