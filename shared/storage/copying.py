"""Copies objects and computes their hashes meanwhile; downloads objects to local files."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from shared.config.private_files import create_private_file
from shared.storage.protocol import ObjectStore, writing

COPY_BYTES = 1024 * 1024
PARTIAL_SUFFIX = ".partial"
STALE_PARTIAL_SECONDS = 3600.0  # age of partial files whose process must have been killed


def _copy_and_hash(source: BinaryIO, write: Callable[[bytes], object]) -> tuple[int, str]:
    """Pass the file's bytes to `write`; return their number and SHA-256."""
    digest, size = hashlib.sha256(), 0
    while block := source.read(COPY_BYTES):
        digest.update(block)
        write(block)
        size += len(block)
    return size, digest.hexdigest()


def hash_file(file: BinaryIO) -> tuple[int, str]:
    """Return the size in bytes and the SHA-256 of a file that is at its beginning."""
    sha256 = hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]
    return file.tell(), sha256


def copy_object(source: ObjectStore, target: ObjectStore, key: str) -> tuple[int, str]:
    """Copy an object; return its size in bytes and SHA-256. NotFound when it is missing."""
    with source.open(key) as file, writing(target, key) as writer:
        return _copy_and_hash(file, writer.write)


def hash_object(store: ObjectStore, key: str) -> tuple[int, str]:
    """Return an object's size in bytes and SHA-256. NotFound when it is missing."""
    with store.open(key) as file:
        return hash_file(file)


def download_object(store: ObjectStore, key: str, target: Path) -> str:
    """Download an object to a file that is synced to disk and private; return its SHA-256.

    Raises NotFound if the object is missing.
    """
    with store.open(key) as source, create_private_file(target) as file:
        _, sha256 = _copy_and_hash(source, file.write)
        file.flush()
        os.fsync(file.fileno())
    return sha256


def remove_stale_partials(folder: Path) -> None:
    """Delete the partial files that killed processes have left in a folder."""
    stale_before = time.time() - STALE_PARTIAL_SECONDS
    for path in folder.glob(f"*{PARTIAL_SUFFIX}"):
        with contextlib.suppress(FileNotFoundError):  # another process may delete it, too
            if path.stat().st_mtime < stale_before:
                path.unlink()
