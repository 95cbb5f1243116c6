"""The parts of a process that run beside its HTTP server: threads that may not die unnoticed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)

Run = Callable[[threading.Event], None]
"""Works until the event is set."""


def start_part(
    name: str, run: Run, stop: threading.Event, on_death: Callable[[], None]
) -> threading.Thread:
    """The part at work in a thread; `on_death` is called when it raises."""

    def guarded() -> None:
        try:
            run(stop)
        except BaseException:
            log.exception("the %s died", name)
            on_death()

    part = threading.Thread(target=guarded, name=name)
    part.start()
    return part
