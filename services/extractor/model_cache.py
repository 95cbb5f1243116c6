"""Files of added models on this machine, with their hash checked.

Where objects are files already they are read where they lie. From a bucket they are fetched into a
folder that the processes of this machine may share, up to MODEL_CACHE_BYTES.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import time
from pathlib import Path
from typing import BinaryIO

from shared.errors import Unavailable
from shared.ids import new_id
from shared.objects import ObjectStore
from shared.private_files import create_private_file, make_private_folder

log = logging.getLogger(__name__)

COPY_BYTES = 1 << 20
STALE_PARTIAL_SECONDS = 3600.0  # a file that is still being fetched then: its process was killed


class ModelFileCache:
    def __init__(self, store: ObjectStore, folder: Path, max_bytes: int) -> None:
        """`folder` is made when something is fetched. `max_bytes` of models that are not in use."""
        self._store = store
        self._folder = folder
        self._max_bytes = max_bytes

    def local_path(self, key: str, sha256: str) -> Path:
        """The object as a file of this machine, to be opened soon: a later call may remove it.

        Unavailable (`model_corrupt`) when it is not what was stored; NotFound and Unavailable of
        the store.
        """
        there = self._store.file(key)
        if there is not None:
            with self._store.open(key) as opened:
                _verify_hash(opened, key, sha256)
            return there
        path = self._folder / f"{sha256}.safetensors"
        with contextlib.suppress(FileNotFoundError, Unavailable):
            with path.open("rb") as opened:
                _verify_hash(opened, key, sha256)
            os.utime(path)  # used just now
            return path
        self._download(key, sha256, path)
        self._evict(path)
        return path

    def _download(self, key: str, sha256: str, path: Path) -> None:
        make_private_folder(self._folder)
        partial = self._folder / f"{new_id()}.partial"
        try:
            with self._store.open(key) as source, create_private_file(partial) as file:
                _verify_hash(source, key, sha256, file)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
        log.info("the model %s was fetched (%d bytes)", sha256[:12], path.stat().st_size)

    def _evict(self, fetched: Path) -> None:
        """Remove what was used least lately, until the rest beside `fetched` fits."""
        long_ago = time.time() - STALE_PARTIAL_SECONDS
        found: list[tuple[float, int, Path]] = []
        for path in self._folder.iterdir():
            with contextlib.suppress(FileNotFoundError):  # another process makes room, too
                about = path.stat()
                if path.suffix == ".partial":
                    if about.st_mtime < long_ago:
                        path.unlink()
                elif path != fetched:
                    found.append((about.st_mtime, about.st_size, path))
        room = self._max_bytes
        for _, size_bytes, path in sorted(found, reverse=True):
            room -= size_bytes
            if room < 0:
                path.unlink(missing_ok=True)


def _verify_hash(source: BinaryIO, key: str, sha256: str, copy: BinaryIO | None = None) -> None:
    """Read it whole, into `copy` if there is one; Unavailable when its hash is another."""
    digest = hashlib.sha256()
    while piece := source.read(COPY_BYTES):
        digest.update(piece)
        if copy is not None:
            copy.write(piece)
    if digest.hexdigest() != sha256:
        raise Unavailable(
            "model_corrupt",
            f"The model {key} is not what was stored (its hash differs). Restore it from a "
            "backup, or add the same checkpoint again under its name (POST /api/v1/models).",
        )
