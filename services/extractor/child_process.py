"""Runs a function in a child process: what takes minutes, and may need more memory than there is.

The child has a low priority, so that queries go first, and dies with its parent.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, TypeVar

NICENESS = 19
POLL_SECONDS = 0.5  # between two looks whether the work is still wanted

Result = TypeVar("Result")


class ChildKilled(Exception):
    """The child process ended without a result, for example because memory ran out."""


def run_in_child(
    function: Callable[..., Result],
    *args: Any,
    on_progress: Callable[..., None],
    check: Callable[[], None],
) -> Result:
    """Run `function(*args, report)` in a new process and return its result.

    Args:
        function: A function of a module. What it passes to `report` is passed to `on_progress`.
        args: Picklable arguments.
        check: Called about every POLL_SECONDS; raises if the work is not wanted any more.

    Raises:
        ChildKilled: The process died.
        Exception: What the function, `on_progress` or `check` raises; the child has ended then.
    """
    # Forking is not safe in a process with torch's threads and locks.
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=[sender, function, args], name=function.__name__)
    process.start()
    sender.close()
    try:
        while True:
            check()
            if not receiver.poll(POLL_SECONDS):
                continue
            what, value = receiver.recv()
            if what == "result":
                result: Result = value
                return result
            if what == "error":
                raise value
            on_progress(*value)
    except EOFError:
        process.join()
        raise ChildKilled(
            f"its process ended with code {process.exitcode}; -9 means that it was killed, perhaps "
            "because memory ran out"
        ) from None
    finally:
        process.kill()
        process.join()
        receiver.close()


def _run(sender: Connection, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
    exit_with_parent()
    os.nice(NICENESS)

    def report(*progress: Any) -> None:
        sender.send(("progress", progress))

    try:
        sender.send(("result", function(*args, report)))
    except Exception as error:
        error.add_note(traceback.format_exc())
        sender.send(("error", error))


def exit_with_parent() -> None:
    """End this process, at once and wherever it is, when the one that has started it ends."""

    def wait() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
