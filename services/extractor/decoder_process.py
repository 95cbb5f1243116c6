"""What runs in decoder processes. Imports little, because photos wait for a process to start.

Pixels return through memory that the pool has opened, because a pipe passes 64 kB at a time and its
reader would hold the worker's interpreter meanwhile.
"""

from __future__ import annotations

import functools
import importlib
import pickle
import signal
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

if TYPE_CHECKING:
    from shared.imaging.decode import DecodedPhoto

_open_store = functools.lru_cache(maxsize=2)(pickle.loads)  # its connections stay open
PILLOW_BLOCK_BYTES, PILLOW_CACHED_BLOCKS = 256 * 1024, 512


@dataclass(frozen=True, slots=True)
class StoredPhoto:
    """A photo that its decoder reads from the object store, and where it stores the previews."""

    store: bytes
    """The pickled object store."""
    key: str
    thumbnail_key: str | None = None
    preview_key: str | None = None


def prepare_process(store_module: str) -> None:
    """Let Pillow reuse its memory, and import the store that the first photo needs."""
    # Without reuse, in blocks that fit images of any size, every image's memory is mapped page by
    # page and returned to the system, which took almost half of the decoding time.
    Image.core.set_block_size(PILLOW_BLOCK_BYTES)  # type: ignore[attr-defined]
    Image.core.set_blocks_max(PILLOW_CACHED_BLOCKS)  # type: ignore[attr-defined]
    importlib.import_module(store_module)


def decode_into_memory(
    decode: Callable[[bytes], DecodedPhoto],
    photo: bytes | StoredPhoto,
    seconds: float,
    path: str,
    name: str,
) -> tuple[bytes, list[int]]:
    """Write the arrays of the decoded photo to a file in memory.

    Args:
        decode: Decodes a photo.
        photo: The photo. Of a stored one, thumbnail and preview are stored and not returned.
        seconds: Time limit of `decode`, after which SIGALRM ends this process.
        path: Path of the file.
        name: Name of the file: the path may be that of another file, if the parent waits no longer.

    Returns:
        The pickled photo without its arrays, and the sizes of these.

    Raises:
        FileNotFoundError: The parent waits no longer.
        PlacewiseError: As `decode` or the object store raises it.
    """
    data = photo if isinstance(photo, bytes) else _open_store(photo.store).get(photo.key)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        decoded = decode(data)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    if isinstance(photo, StoredPhoto):
        decoded = _store_previews(photo, decoded)
    buffers: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(decoded, protocol=5, buffer_callback=buffers.append)
    with Path(path).open("r+b", buffering=0) as file:
        opened = Path(f"/proc/self/fd/{file.fileno()}")  # of Linux alone
        if opened.is_symlink() and name not in str(opened.readlink()):
            raise FileNotFoundError(name)
        arrays = [buffer.raw() for buffer in buffers]
        for array in arrays:
            file.write(array)
    return pickled, [array.nbytes for array in arrays]


def _store_previews(photo: StoredPhoto, decoded: DecodedPhoto) -> DecodedPhoto:
    store = _open_store(photo.store)
    if photo.thumbnail_key is not None:
        store.put(photo.thumbnail_key, decoded.thumbnail)
    if photo.preview_key is not None and decoded.preview is not None:
        store.put(photo.preview_key, decoded.preview)
    return replace(decoded, thumbnail=b"", preview=None)
