"""Heartbeats: a file that a service's loop touches, so that a health check sees whether it turns.

For services that answer no HTTP. `python -m shared.telemetry.heartbeat FILE SECONDS` is the
check: exit code
0 when the file was touched within that many seconds. It imports nothing, because it is run often.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path


class Heartbeat:
    """Beats by touching `file`; None for no file, and then a beat does nothing."""

    def __init__(self, file: Path | None) -> None:
        self._file = file

    def beat(self) -> None:
        """The loop has gone round once more. Raises OSError where the file can't be written."""
        if self._file is not None:
            self._file.touch()


def seconds_since_heartbeat(file: Path) -> float:
    """Seconds since the last beat; infinite when there was none."""
    try:
        return time.time() - file.stat().st_mtime
    except FileNotFoundError:
        return float("inf")


def main(arguments: list[str]) -> int:
    """The check, with a line for whoever reads the orchestrator's log."""
    file, most_seconds = Path(arguments[0]), float(arguments[1])
    silent = seconds_since_heartbeat(file)
    print(f"last beat {silent:.0f} s ago, {most_seconds:g} s are allowed")  # noqa: T201
    return 0 if silent <= most_seconds else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
