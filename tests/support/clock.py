"""Processes that are mistaken about the time of day."""

from __future__ import annotations

from pathlib import Path

import libfaketime


def clock_off_by(seconds: int) -> dict[str, str]:
    """Variables of a process whose clock is so far ahead or behind; its monotonic one is right."""
    folder = Path(libfaketime.__file__).parent / "vendor" / "libfaketime" / "src"
    return {
        "LD_PRELOAD": str(folder / "libfaketime.so.1"),
        "FAKETIME": f"{seconds:+d}s",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
    }
