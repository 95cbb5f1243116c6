"""The parts of a process that run beside its HTTP server: threads that may not die unnoticed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)

RunUntilStopped = Callable[[threading.Event], None]
"""Works until the event is set."""


def start_service_thread(
    name: str, run: RunUntilStopped, stop: threading.Event, on_crash: Callable[[], None]
) -> threading.Thread:
    """The part at work in a thread; `on_crash` is called when it raises."""

    def guarded() -> None:
        try:
            run(stop)
        except BaseException:
            log.exception("the %s died", name)
            on_crash()

    part = threading.Thread(target=guarded, name=name)
    part.start()
    return part
