"""Unpacks a zip or tar of photos into a temporary folder, which is indexed like any other."""

from __future__ import annotations

import contextlib
import io
import shutil
import tarfile
import zipfile
import zlib
from pathlib import Path
from typing import cast

from services.cli.output import printable_path
from shared.errors import InvalidRequest

TABLE_NAME, MANIFEST_NAME = "photos.csv", "manifest.jsonl"

# What the standard library raises for content that it can't read, or that is encrypted.
READ_ERRORS = (
    EOFError,
    OSError,
    RuntimeError,
    ValueError,
    tarfile.TarError,
    zipfile.BadZipFile,
    zlib.error,
)


def is_archive(path: Path) -> bool:
    """Return whether a file is a zip or tar by its content, also a compressed tar."""
    try:
        return path.is_file() and (zipfile.is_zipfile(path) or tarfile.is_tarfile(path))
    except READ_ERRORS:
        return False


def unpack_archive(path: Path, folder: Path) -> Path | None:
    """Unpack an archive into a folder, without its links and devices.

    Returns:
        The archive's own table of metadata, if it has one: the outermost `photos.csv` or
        `manifest.jsonl`.

    Raises:
        InvalidRequest: `unreadable_file` if the archive is damaged or encrypted, or does not fit;
            `several_manifests`.
    """
    try:
        if zipfile.is_zipfile(path):
            with _open_zip(path) as zipped:
                zipped.extractall(folder)  # noqa: S202 keeps names inside the folder
        else:
            with tarfile.open(path, encoding="utf-8", errors="replace") as tar:
                unpack_tar(tar, folder)
    except READ_ERRORS as error:
        raise InvalidRequest(
            "unreadable_file",
            f"Can't read {printable_path(path)}: {error}. Unpack it and index the folder, or "
            "create it again.",
        ) from None
    tables = [*folder.rglob(TABLE_NAME), *folder.rglob(MANIFEST_NAME)]
    outermost = min((len(table.parts) for table in tables), default=0)
    found = [table for table in tables if len(table.parts) == outermost]
    if len(found) > 1:
        names = ", ".join(str(table.relative_to(folder)) for table in found)
        raise InvalidRequest(
            "several_manifests", f"The archive has several tables: {names}. Remove all but one."
        )
    return found[0] if found else None


def _open_zip(path: Path) -> zipfile.ZipFile:
    # Many zips have UTF-8 names without the flag; by APPNOTE.TXT 4.4.4 that is code page 437.
    with contextlib.suppress(UnicodeError):
        return zipfile.ZipFile(path, metadata_encoding="utf-8")
    return zipfile.ZipFile(path)


def unpack_tar(tar: tarfile.TarFile, folder: Path) -> None:
    """Write the files below the folder, whatever their names; Python has filters since 3.11.4."""
    for member in tar:
        if member.size < 0:  # `tarfile` would read the same members for ever
            raise tarfile.ReadError("a member declares a negative size")
        source = tar.extractfile(member) if member.isreg() else None
        if source is not None:
            parts = (part for part in member.name.split("/") if part not in ("", ".", ".."))
            file = folder.joinpath(*parts)
            file.parent.mkdir(parents=True, exist_ok=True)
            with file.open("wb") as target:
                shutil.copyfileobj(source, target)
    _check_end(tar)


def _check_end(tar: tarfile.TarFile) -> None:
    """Raise ReadError unless the archive ends: `tarfile` takes a damaged header for the end."""
    stream = cast("io.BufferedIOBase", tar.fileobj)
    stream.seek(tar.offset)
    if stream.read(tarfile.BLOCKSIZE) != bytes(tarfile.BLOCKSIZE):
        raise tarfile.ReadError(f"no header and no end at byte {tar.offset}")
