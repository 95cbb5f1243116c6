"""Background threads of a service process, with a callback for crashes."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)

RunUntilStopped = Callable[[threading.Event], None]
"""Runs until the event is set."""


def start_service_thread(
    name: str, run: RunUntilStopped, stop: threading.Event, on_crash: Callable[[], None]
) -> threading.Thread:
    """Starts `run(stop)` in a thread; logs its exception and calls `on_crash` if it raises."""

    def guarded() -> None:
        try:
            run(stop)
        except BaseException:
            log.exception("the service thread %s crashed", name)
            on_crash()

    thread = threading.Thread(target=guarded, name=name)
    thread.start()
    return thread
