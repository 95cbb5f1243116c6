"""A catalog file that can't be used: what happened, to which file, and the ways out."""

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

# Larger catalogs are checked by `placewise doctor` only: this reads all of it, at 1 GB/s or so.
MAX_CHECKED_BYTES = 256_000_000

WAYS_OUT = (
    "Keep it, move it away with its -wal and -shm files, then restore a backup (placewise restore "
    "FOLDER, into an empty PLACEWISE_HOME) or make a new catalog from the object store (placewise "
    "rebuild-catalog)."
)


@contextlib.contextmanager
def opening(catalog: Catalog) -> Iterator[None]:
    """Explain what SQLite refuses while a process starts.

    Raises Misconfigured: `catalog_is_folder`, `catalog_unreadable`, `catalog_damaged`, `disk_full`.
    Everything else, and every error of PostgreSQL, is raised as it is.
    """
    path = sqlite_file(catalog)
    if path is None:
        yield
        return
    _check_file(path)
    try:
        yield
    except SQLAlchemyError as error:
        raise _explained(path, error) or error from error


def check_pages(catalog: Catalog, max_bytes: int | None = MAX_CHECKED_BYTES) -> None:
    """Read every page of a catalog file of up to `max_bytes`; Misconfigured as `opening` raises."""
    path = sqlite_file(catalog)
    if path is None or not path.exists():
        return
    if max_bytes is not None and path.stat().st_size > max_bytes:
        return
    with opening(catalog), catalog.read() as session:
        found = session.scalar(text("PRAGMA quick_check(1)"))
    if found != "ok":
        raise _damaged(path, str(found).splitlines()[-1])


def sqlite_file(catalog: Catalog) -> Path | None:
    """The catalog's file; None for PostgreSQL and for a database in memory."""
    name = catalog.url.database
    return Path(name) if catalog.is_sqlite and name and name != ":memory:" else None


def _check_file(path: Path) -> None:
    if path.is_dir():
        raise Misconfigured(
            "catalog_is_folder",
            f"{path} is a folder, and the catalog is a file of that name. Move the folder away, or "
            "correct PLACEWISE_HOME or DATABASE_URL.",
        )
    if path.exists() and not os.access(path, os.R_OK | os.W_OK):
        raise _unreadable(path)


def _explained(path: Path, error: SQLAlchemyError) -> Misconfigured | None:
    name = str(getattr(getattr(error, "orig", None), "sqlite_errorname", ""))
    if name.startswith(DAMAGED):
        return _damaged(path, reason_of(error))
    free = shutil.disk_usage(path.parent).free if path.parent.is_dir() else None
    full = free is not None and free < RELEASE_BELOW_BYTES
    if name == "SQLITE_FULL" or (name.startswith(("SQLITE_IOERR", "SQLITE_CANTOPEN")) and full):
        return Misconfigured(
            "disk_full",
            f"The disk of {path} is full ({free} bytes free), and the catalog needs some megabytes "
            "to be opened. Make room on that disk, then start again; photos and maps can be "
            "deleted once the server runs.",
        )
    if name.startswith(("SQLITE_CANTOPEN", "SQLITE_READONLY", "SQLITE_PERM", "SQLITE_AUTH")):
        return _unreadable(path)
    if name.startswith("SQLITE_IOERR"):
        unavailable = to_unavailable(error)
        assert unavailable is not None
        return Misconfigured(unavailable.code, f"{path}: {unavailable.detail}")
    return None


def _damaged(path: Path, reason: str) -> Misconfigured:
    return Misconfigured(
        "catalog_damaged", f"The catalog {path} can't be used: {reason}. {WAYS_OUT}"
    )


def _unreadable(path: Path) -> Misconfigured:
    return Misconfigured(
        "catalog_unreadable",
        f"The catalog {path} can't be opened to read and write. Check the permissions and the "
        "owner of the file, of its -wal and -shm files and of its folder.",
    )
