"""`placewise`, one thread of which does nothing until SIGRTMIN and then crashes: NAME ARGUMENTS."""

from __future__ import annotations

import signal
import sys
import threading

from services.cli import main


def crash_on_signal(name: str) -> None:
    signalled = threading.Event()
    signal.signal(signal.SIGRTMIN, lambda *_: signalled.set())
    run = threading.Thread.run

    def run_or_crash(self: threading.Thread) -> None:
        if self.name != name:
            run(self)
            return
        signalled.wait()
        raise RuntimeError(f"{name} was asked to crash")

    threading.Thread.run = run_or_crash  # type: ignore[method-assign]


if __name__ == "__main__":
    crash_on_signal(sys.argv.pop(1))
    main()
