"""What a decoding child does first. It imports little: photos wait for a child that starts."""

from __future__ import annotations

import resource

from PIL import Image

# Of Pillow's blocks, 16 MiB at most each, kept by a child between two photos.
PILLOW_CACHED_BLOCKS = 8


def limit_memory(limit_bytes: int) -> None:
    """Of this process: what a photo needs beyond `limit_bytes` is refused to its decoder."""
    resource.setrlimit(resource.RLIMIT_AS, (limit_bytes, limit_bytes))
    # Otherwise the memory of each picture comes page by page from the system, and goes back: that
    # took almost half of the time of decoding one.
    Image.core.set_blocks_max(PILLOW_CACHED_BLOCKS)  # type: ignore[attr-defined]
