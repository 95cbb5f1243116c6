"""The memory of a process, from /proc."""

from __future__ import annotations

from pathlib import Path


def memory_bytes(name: str, pid: int | str = "self") -> int:
    """`VmRSS`, the resident set size, `VmHWM`, its peak, or `RssAnon`, without mapped files."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * 1024
    raise AssertionError(f"/proc/{pid}/status has no {name}")


def reset_peak_memory() -> None:
    """Reset the peak to the current resident set size."""
    Path("/proc/self/clear_refs").write_text("5")
