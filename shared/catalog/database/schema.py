"""Creation of the catalog's tables, and the check that they are those of this version.

`placewise storage migrate` creates them before the services start; the embedded Placewise does at
startup.
Services only check them (`wait_for_schema`). Versions before the first release do not read each
other's catalogs: a catalog of another one is refused, and `placewise storage rebuild` creates a new
one from the object store.

Errors of an SQLite file while a process starts name the file, the cause and the remedies
(`opening`).
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import sqlite3
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from sqlalchemy import Connection, inspect, text
from sqlalchemy.dialects import postgresql
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.schema import CreateIndex, CreateTable, DDLElement

from shared.catalog.database.base import Base
from shared.catalog.database.errors import DAMAGED, explain_outage, is_permanent, reason_of
from shared.catalog.database.session import Catalog, TransactionTimeouts
from shared.config.private_files import FILE_MODE, make_private_folder
from shared.errors import Misconfigured, PlacewiseError

log = logging.getLogger(__name__)

MIGRATIONS = Path(__file__).parent.parent / "migrations"
MIN_POSTGRES_VERSION = (14,)
MIN_SQLITE_VERSION = (3, 35)  # RETURNING, MATERIALIZED
ADVISORY_LOCK_ID = 1886151011  # "plac" in ASCII

# Only other processes that create the tables are waited for.
MIGRATION_TIMEOUTS = TransactionTimeouts(statement_seconds=0, lock_seconds=60.0)
VERSION_TABLE = "alembic_version"
NEARLY_FULL_BYTES = 4 * 1024 * 1024  # opening a catalog may need them
SCHEMA_POLL_SECONDS = 0.5


def migrate(catalog: Catalog) -> None:
    """Create the tables in an empty database; safe to run from several processes at once.

    Raises:
        Unavailable: `catalog_unavailable`, or `catalog_busy` if another process does not finish.
        Misconfigured: As `opening` raises, for an SQLite file that can't be used; `schema_differs`;
            `postgres_too_old`, `sqlite_too_old`.
    """
    try:
        if catalog.is_sqlite:
            with opening(catalog):
                check_pages(catalog)
                _migrate_sqlite(catalog)
        else:
            _check_postgres_version(catalog)
            _migrate_postgres(catalog)
    except SQLAlchemyError as error:
        unavailable = explain_outage(error)
        if unavailable is None:
            raise
        raise unavailable from error


def check_schema(catalog: Catalog) -> None:
    """Check that the catalog has the tables of this version.

    Raises:
        Misconfigured: `schema_missing`: the database is empty. `schema_differs`: another version
            created the tables.
    """
    with catalog.read() as session:
        if not _is_current(catalog, session.connection()):
            raise Misconfigured(
                "schema_missing", "The catalog has no tables. Run `placewise storage migrate` once."
            )


def wait_for_schema(catalog: Catalog, seconds: float) -> None:
    """Wait until the catalog is reachable and has the tables of this version.

    In an SQLite catalog, which only processes of one machine share, they are created instead.

    Raises:
        Unavailable: The catalog is not reachable after `seconds`; at once if that will not change,
            as after a wrong password.
        Misconfigured: As `check_schema` raises, after `seconds`; `schema_differs` at once.
    """
    if catalog.is_sqlite:
        migrate(catalog)
        return
    deadline, has_warned = time.monotonic() + seconds, False
    while True:
        try:
            check_schema(catalog)
            return
        except (Misconfigured, SQLAlchemyError) as error:
            reason = explain_outage(error) or error
            differs = isinstance(reason, Misconfigured) and reason.code == "schema_differs"
            if not isinstance(reason, PlacewiseError):
                raise
            if differs or is_permanent(error) or time.monotonic() > deadline:
                raise reason from error
            if not has_warned:
                has_warned = True
                log.warning("waiting up to %g s: %s", seconds, reason.detail)
        time.sleep(SCHEMA_POLL_SECONDS)


@cache
def schema_revision() -> str:
    """Return a name of the tables of this version: a hash of the statements that create them."""
    import shared.catalog.tables  # noqa: F401  (registers every table)

    dialect = postgresql.dialect()  # type: ignore[no-untyped-call]
    statements: list[DDLElement] = []
    for table in Base.metadata.sorted_tables:
        statements.append(CreateTable(table))
        statements += [CreateIndex(i) for i in sorted(table.indexes, key=lambda i: str(i.name))]
    created = "\n".join(str(statement.compile(dialect=dialect)) for statement in statements)
    return hashlib.sha256(created.encode()).hexdigest()[:12]


def _is_current(catalog: Catalog, connection: Connection) -> bool:
    """Return whether the tables of this version exist; False in an empty database."""
    if not inspect(connection).has_table(VERSION_TABLE):
        return False
    present = connection.scalar(text(f"SELECT version_num FROM {VERSION_TABLE}"))  # noqa: S608
    if present == schema_revision():
        return True
    file = sqlite_file(catalog)
    remedy = (
        "let DATABASE_URL name an empty database, run `placewise storage migrate`"
        if file is None
        else f"move {file} (and its -wal and -shm files) away without deleting it"
    )
    raise Misconfigured(
        "schema_differs",
        f"The catalog was created by another version of Placewise (schema {present}; this version "
        f"has {schema_revision()}), and versions before the first release do not read each other's "
        "catalogs. Nothing was changed. Start that version again; or create a new catalog from the "
        f"object store, which stays as it is: {remedy}, and run `placewise storage rebuild`.",
        present=present,
        needed=schema_revision(),
    )


def _migrate_sqlite(catalog: Catalog) -> None:
    """Create the tables in one transaction, which excludes every other process."""
    if sqlite3.sqlite_version_info < MIN_SQLITE_VERSION:
        raise Misconfigured(
            "sqlite_too_old",
            f"This Python has SQLite {sqlite3.sqlite_version}; 3.35 or newer is required. Use "
            "another Python (rm -r .venv; make run PYTHON=python3.12), or set DATABASE_URL to a "
            "PostgreSQL.",
        )
    if catalog.url.database:
        file = Path(catalog.url.database)
        make_private_folder(file.parent)
        file.touch(FILE_MODE)  # SQLite gives its -wal and -shm files the same mode
    with catalog.read() as session:
        if _is_current(catalog, session.connection()):
            return
    with catalog.engine.execution_options(placewise_write=True).begin() as connection:
        _create_tables(catalog, connection)


def _check_postgres_version(catalog: Catalog) -> None:
    with catalog.engine.connect() as connection:
        present = connection.dialect.server_version_info or ()
    if present < MIN_POSTGRES_VERSION:
        raise Misconfigured(
            "postgres_too_old",
            f"PostgreSQL {'.'.join(map(str, present))} is too old. Upgrade to "
            f"{MIN_POSTGRES_VERSION[0]} or newer.",
        )


def _migrate_postgres(catalog: Catalog) -> None:
    engine = catalog.engine.execution_options(placewise_limits=MIGRATION_TIMEOUTS)
    with engine.begin() as connection:
        connection.execute(text(f"SELECT pg_advisory_xact_lock({ADVISORY_LOCK_ID})"))
        _create_tables(catalog, connection)


def _create_tables(catalog: Catalog, connection: Connection) -> None:
    if _is_current(catalog, connection):  # another process was faster
        return
    # Imported here: most starts find the tables, and loading Alembic takes a while.
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


# Only `placewise doctor` checks larger catalogs: the check reads the whole file, at about 1 GB/s.
MAX_CHECKED_BYTES = 256_000_000

REMEDIES = (
    "Move it and its -wal and -shm files away without deleting them, then restore a backup "
    "(placewise storage restore FOLDER, into an empty PLACEWISE_HOME) or create a new catalog from "
    "the object store (placewise storage rebuild)."
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
    full = free is not None and free < NEARLY_FULL_BYTES
    if name == "SQLITE_FULL" or (name.startswith(("SQLITE_IOERR", "SQLITE_CANTOPEN")) and full):
        return Misconfigured(
            "disk_full",
            f"The disk of {path} is full ({free} bytes free); opening the catalog needs a few "
            "megabytes. Free space on that disk, then start again; you can delete photos and maps "
            "once the server runs.",
        )
    if name.startswith(("SQLITE_CANTOPEN", "SQLITE_READONLY", "SQLITE_PERM", "SQLITE_AUTH")):
        return _unreadable_error(path)
    if name.startswith("SQLITE_IOERR"):
        unavailable = explain_outage(error)
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
