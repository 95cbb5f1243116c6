"""Initializer of decoder processes. Imports little, because photos wait for a process to start."""

from __future__ import annotations

import resource

from PIL import Image

# Memory blocks, 16 MiB at most each, that Pillow keeps for reuse between photos.
PILLOW_CACHED_BLOCKS = 8


def limit_memory(limit_bytes: int) -> None:
    """Limit this process's address space, so that a photo that needs more can't be decoded."""
    resource.setrlimit(resource.RLIMIT_AS, (limit_bytes, limit_bytes))
    # Without reuse, every image's memory is mapped page by page and returned to the system, which
    # took almost half of the decoding time.
    Image.core.set_blocks_max(PILLOW_CACHED_BLOCKS)  # type: ignore[attr-defined]
