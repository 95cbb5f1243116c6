"""Checks of the SQLite catalog file, with errors that name the file, the cause and the remedies."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from shared.catalog.database_errors import DAMAGED, reason_of, to_unavailable
from shared.catalog.session import Catalog
from shared.config.disk_space import RELEASE_BELOW_BYTES
from shared.errors import Misconfigured

# Only `placewise doctor` checks larger catalogs: the check reads the whole file, at about 1 GB/s.
MAX_CHECKED_BYTES = 256_000_000

REMEDIES = (
    "Move it and its -wal and -shm files away without deleting them, then restore a backup "
    "(placewise restore FOLDER, into an empty PLACEWISE_HOME) or create a new catalog from the "
    "object store (placewise rebuild-catalog)."
)


@contextlib.contextmanager
def opening(catalog: Catalog) -> Iterator[None]:
    """Convert errors of SQLite while a process starts into errors that explain them.

    Other errors, and all of PostgreSQL, are raised unchanged.

    Raises:
        Misconfigured: `catalog_is_folder`, `catalog_unreadable`, `catalog_damaged`,
            `catalog_io_error` or `disk_full`.
    """
    path = sqlite_file(catalog)
    if path is None:
        yield
        return
    _check_file(path)
    try:
        yield
    except SQLAlchemyError as error:
        raise _to_misconfigured(path, error) or error from error


def check_pages(catalog: Catalog, max_bytes: int | None = MAX_CHECKED_BYTES) -> None:
    """Check every page of a catalog file of up to `max_bytes`; raises as `opening` does."""
    path = sqlite_file(catalog)
    if path is None or not path.exists():
        return
    if max_bytes is not None and path.stat().st_size > max_bytes:
        return
    with opening(catalog), catalog.read() as session:
        result = session.scalar(text("PRAGMA quick_check(1)"))
    if result != "ok":
        raise _damaged_error(path, str(result).splitlines()[-1])


def sqlite_file(catalog: Catalog) -> Path | None:
    """Return the catalog's file; None for PostgreSQL and for an in-memory database."""
    name = catalog.url.database
    return Path(name) if catalog.is_sqlite and name and name != ":memory:" else None


def _check_file(path: Path) -> None:
    if path.is_dir():
        raise Misconfigured(
            "catalog_is_folder",
            f"{path} is a folder, but the catalog has to be a file of that name. Move the folder "
            "away, or correct PLACEWISE_HOME or DATABASE_URL.",
        )
    if path.exists() and not os.access(path, os.R_OK | os.W_OK):
        raise _unreadable_error(path)


def _to_misconfigured(path: Path, error: SQLAlchemyError) -> Misconfigured | None:
    name = str(getattr(getattr(error, "orig", None), "sqlite_errorname", ""))
    if name.startswith(DAMAGED):
        return _damaged_error(path, reason_of(error))
    free = shutil.disk_usage(path.parent).free if path.parent.is_dir() else None
    full = free is not None and free < RELEASE_BELOW_BYTES
    if name == "SQLITE_FULL" or (name.startswith(("SQLITE_IOERR", "SQLITE_CANTOPEN")) and full):
        return Misconfigured(
            "disk_full",
            f"The disk of {path} is full ({free} bytes free); opening the catalog needs a few "
            "megabytes. Make room on that disk, then start again; you can delete photos and maps "
            "once the server runs.",
        )
    if name.startswith(("SQLITE_CANTOPEN", "SQLITE_READONLY", "SQLITE_PERM", "SQLITE_AUTH")):
        return _unreadable_error(path)
    if name.startswith("SQLITE_IOERR"):
        unavailable = to_unavailable(error)
        assert unavailable is not None
        return Misconfigured(unavailable.code, f"{path}: {unavailable.detail}")
    return None


def _damaged_error(path: Path, reason: str) -> Misconfigured:
    return Misconfigured("catalog_damaged", f"The catalog {path} is damaged: {reason}. {REMEDIES}")


def _unreadable_error(path: Path) -> Misconfigured:
    return Misconfigured(
        "catalog_unreadable",
        f"The catalog {path} can't be opened for reading and writing. Check the permissions and "
        "the owner of the file, of its -wal and -shm files, and of its folder.",
    )
