"""What runs in decoder processes. Imports little, because photos wait for a process to start.

Pixels return through memory that the pool has opened, because a pipe passes 64 kB at a time and its
reader would hold the worker's interpreter meanwhile.
"""

from __future__ import annotations

import pickle
import resource
from collections.abc import Callable
from pathlib import Path

from PIL import Image

# Memory blocks, 16 MiB at most each, that Pillow keeps for reuse between photos.
PILLOW_CACHED_BLOCKS = 8


def limit_memory(limit_bytes: int) -> None:
    """Limit this process's address space, so that a photo that needs more can't be decoded."""
    resource.setrlimit(resource.RLIMIT_AS, (limit_bytes, limit_bytes))
    # Without reuse, every image's memory is mapped page by page and returned to the system, which
    # took almost half of the decoding time.
    Image.core.set_blocks_max(PILLOW_CACHED_BLOCKS)  # type: ignore[attr-defined]


def decode_into_memory(
    decode: Callable[[bytes], object], data: bytes, path: str, name: str
) -> tuple[bytes, list[int]]:
    """Write the arrays of the decoded photo to a file in memory.

    Args:
        decode: Decodes the photo `data`.
        path: Path of the file.
        name: Name of the file: the path may be that of another file, if the parent waits no longer.

    Returns:
        The pickled photo without its arrays, and the sizes of these.

    Raises:
        FileNotFoundError: The parent waits no longer.
    """
    buffers: list[pickle.PickleBuffer] = []
    photo = pickle.dumps(decode(data), protocol=5, buffer_callback=buffers.append)
    with Path(path).open("r+b", buffering=0) as file:
        opened = Path(f"/proc/self/fd/{file.fileno()}")  # of Linux alone
        if opened.is_symlink() and name not in str(opened.readlink()):
            raise FileNotFoundError(name)
        arrays = [buffer.raw() for buffer in buffers]
        for array in arrays:
            file.write(array)
    return photo, [array.nbytes for array in arrays]
