"""What this machine, or this container, gives to a process."""

from __future__ import annotations

import os
from pathlib import Path

CGROUP_MEMORY_LIMIT_FILE = Path("/sys/fs/cgroup/memory.max")


def memory_limit_bytes() -> int:
    """The memory that this process may have: the machine's, or less in a container."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = CGROUP_MEMORY_LIMIT_FILE.read_text().strip()
    except OSError:
        return machine
    return min(machine, int(limit)) if limit.isdigit() else machine  # "max" is no limit
