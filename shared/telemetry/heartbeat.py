"""Heartbeat files, for the health checks of services without an HTTP server.

The main loop of a service touches the file. `python -m shared.telemetry.heartbeat FILE SECONDS` is
the check: it exits with 0 when the file was touched within that many seconds. This module imports
no other package, because the check runs often.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path


class Heartbeat:
    """Touches `file` on each beat; does nothing for None."""

    def __init__(self, file: Path | None) -> None:
        self._file = file

    def beat(self) -> None:
        """Record an iteration of the main loop. Raises OSError when the file can't be written."""
        if self._file is not None:
            self._file.touch()


def seconds_since_heartbeat(file: Path) -> float:
    """Return the seconds since the last beat; infinite without one."""
    try:
        return time.time() - file.stat().st_mtime
    except FileNotFoundError:
        return float("inf")


def main(arguments: list[str]) -> int:
    """Run the check and print its result for the orchestrator's log."""
    file, max_age_seconds = Path(arguments[0]), float(arguments[1])
    age_seconds = seconds_since_heartbeat(file)
    print(f"last beat {age_seconds:.0f} s ago, {max_age_seconds:g} s are allowed")  # noqa: T201
    return 0 if age_seconds <= max_age_seconds else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
