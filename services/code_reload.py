"""Restarts the embedded server when its code changes: with DEBUG, in a checkout."""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path

log = logging.getLogger(__name__)

ROOT = Path(__file__).parents[1]
CODE_FOLDERS = tuple(ROOT / package for package in ("placewise", "services", "shared"))


def can_reload() -> bool:
    """Whether the code runs from a checkout with the extra dev, which has watchfiles."""
    return (ROOT / "pyproject.toml").exists() and find_spec("watchfiles") is not None


def watch_code(
    on_change: Callable[[], object], folders: Iterable[Path] = CODE_FOLDERS
) -> threading.Event:
    """Call `on_change` once, in a thread of its own, when a Python file below the folders changes.

    A file that does not compile is logged instead: the running server continues until it does.

    Returns:
        An event that ends the watch when it is set.
    """
    from watchfiles import PythonFilter, watch

    stop = threading.Event()

    def run() -> None:
        for changes in watch(*folders, watch_filter=PythonFilter(), stop_event=stop):
            paths = sorted({Path(path) for _, path in changes})
            if all(_compiles(path) for path in paths if path.exists()):
                log.info("%s changed: restarting", ", ".join(path.name for path in paths))
                on_change()
                return

    threading.Thread(target=run, name="code reload", daemon=True).start()
    return stop


def _compiles(path: Path) -> bool:
    try:
        compile(path.read_bytes(), path, "exec")
    except SyntaxError as error:
        log.warning("%s:%s: %s; not restarted", path, error.lineno, error.msg)
        return False
    return True


def restart_process() -> None:
    """Replace this process by a new one with the same command, environment and id."""
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606  (our own command)
