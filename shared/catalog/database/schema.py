"""Schema migrations while services run, and the check that a release fits the schema.

`placewise migrate` runs once per release, before its services start; the embedded Placewise
migrates at startup. Services only check the schema (`wait_for_schema`). The rules for migrations
are in docs/how-to/postgresql.md.

Errors of an SQLite file while a process starts name the file, the cause and the remedies
(`opening`).
"""

from __future__ import annotations

import contextlib
import logging
import os
import random
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from sqlalchemy import Connection, inspect, text
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from shared.catalog.database.errors import (
    DAMAGED,
    explain_outage,
    get_sqlstate,
    is_permanent,
    reason_of,
)
from shared.catalog.database.session import Catalog, TransactionTimeouts
from shared.config.disk_space import RELEASE_BELOW_BYTES
from shared.config.private_files import FILE_MODE, make_private_folder
from shared.errors import Misconfigured, PlacewiseError, Unavailable

log = logging.getLogger(__name__)

MIGRATIONS = Path(__file__).parent.parent / "migrations"
MIN_POSTGRES_VERSION = (14,)
ADVISORY_LOCK_ID = 1886151011  # "plac" in ASCII

# While a migration waits for a table's exclusive lock, all later statements on the table wait, too:
# its lock timeout has to be shorter than that of requests. A statement that has its lock may take
# any time.
MIGRATION_TIMEOUTS = TransactionTimeouts(statement_seconds=0, lock_seconds=1.0)
LOCK_NOT_AVAILABLE = "55P03"
DEADLOCK = "40P01"
MIGRATION_TIMEOUT_SECONDS = 300.0
LOCK_RETRY_SECONDS = 1.0
SCHEMA_POLL_SECONDS = 0.5


def migrate(catalog: Catalog, timeout_seconds: float = MIGRATION_TIMEOUT_SECONDS) -> None:
    """Migrate the schema to this release's; safe to run from several processes, while others serve.

    On PostgreSQL each migration is a transaction of its own, with a lock timeout of one second
    after which it is retried, so that traffic continues.

    Args:
        timeout_seconds: Time after which a migration that can't get a lock is not retried.

    Raises:
        Unavailable: `catalog_unavailable`, or `catalog_busy` after `timeout_seconds`.
        Misconfigured: As `opening` raises, for an SQLite file that can't be used;
            `postgres_too_old`.
    """
    try:
        if catalog.is_sqlite:
            with opening(catalog):
                check_pages(catalog)
                _migrate_sqlite(catalog)
        else:
            _check_postgres_version(catalog)
            _migrate_postgres(catalog, time.monotonic() + timeout_seconds)
    except SQLAlchemyError as error:
        unavailable = explain_outage(error)
        if unavailable is None:
            raise
        raise unavailable from error


def check_schema(catalog: Catalog) -> None:
    """Check that this release can work with the catalog's schema.

    Raises:
        Misconfigured: `schema_outdated`: the schema is older than this release needs.
            `schema_too_new`: a later release has changed it incompatibly; additions are compatible.
    """
    known = _known_revisions()
    head = known[-1]
    present, understood_from = _read_schema_revision(catalog)
    if present == head:
        return
    if present is None or present in known:
        raise Misconfigured(
            "schema_outdated",
            f"The catalog's schema is {present or 'missing'}, but this release needs {head}. "
            "Run `placewise migrate` once.",
            present=present,
            needed=head,
        )
    if understood_from not in known:
        raise Misconfigured(
            "schema_too_new",
            f"The catalog's schema is {present}, which requires a release with schema "
            f"{understood_from} or later; this one has {head}. Start the newer release.",
            present=present,
            needed=head,
        )
    log.info("the catalog's schema is %s, newer than this release's %s", present, head)


def wait_for_schema(catalog: Catalog, seconds: float) -> None:
    """Wait until the catalog is reachable and has a schema that this release can work with.

    An SQLite catalog, which only processes of one machine share, is migrated instead.

    Raises:
        Unavailable: The catalog is not reachable after `seconds`; at once if that will not change,
            as after a wrong password.
        Misconfigured: As `check_schema` raises, after `seconds`; `schema_too_new` at once.
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
            too_new = isinstance(reason, Misconfigured) and reason.code == "schema_too_new"
            if not isinstance(reason, PlacewiseError):
                raise
            if too_new or is_permanent(error) or time.monotonic() > deadline:
                raise reason from error
            if not has_warned:
                has_warned = True
                log.warning("waiting up to %g s: %s", seconds, reason.detail)
        time.sleep(SCHEMA_POLL_SECONDS)


def _read_schema_revision(catalog: Catalog) -> tuple[str | None, str | None]:
    """Return the schema's revision, and the oldest revision whose release works with it."""
    with catalog.read() as session:
        tables = set(inspect(session.connection()).get_table_names())
        if "alembic_version" not in tables:
            return None, None
        present = session.scalar(text("SELECT version_num FROM alembic_version"))
        if "schema_compatibility" not in tables:
            return present, None
        return present, session.scalar(text("SELECT understood_from FROM schema_compatibility"))


def _migrate_sqlite(catalog: Catalog) -> None:
    """Run all migrations in one transaction, which excludes every other process."""
    if catalog.url.database:
        file = Path(catalog.url.database)
        make_private_folder(file.parent)
        file.touch(FILE_MODE)  # SQLite gives its -wal and -shm files the same mode
    if _read_schema_revision(catalog)[0] == _known_revisions()[-1]:
        return
    with catalog.engine.execution_options(placewise_write=True).begin() as connection:
        _upgrade(connection)


def _check_postgres_version(catalog: Catalog) -> None:
    with catalog.engine.connect() as connection:
        present = connection.dialect.server_version_info or ()
    if present < MIN_POSTGRES_VERSION:
        raise Misconfigured(
            "postgres_too_old",
            f"PostgreSQL {'.'.join(map(str, present))} is too old. Upgrade to "
            f"{MIN_POSTGRES_VERSION[0]} or newer.",
        )


def _migrate_postgres(catalog: Catalog, deadline: float) -> None:
    engine = catalog.engine.execution_options(placewise_limits=MIGRATION_TIMEOUTS)
    with _migration_lock(catalog, deadline):
        while True:
            try:
                with engine.connect() as connection:
                    _upgrade(connection)
                return
            except DBAPIError as error:
                is_retryable = get_sqlstate(error) in (LOCK_NOT_AVAILABLE, DEADLOCK)
                if not is_retryable or time.monotonic() > deadline:
                    raise
                log.info("a migration could not get a lock because of traffic: retrying")
            time.sleep(LOCK_RETRY_SECONDS * random.uniform(0.5, 1.5))  # noqa: S311


@contextlib.contextmanager
def _migration_lock(catalog: Catalog, deadline: float) -> Iterator[None]:
    """Hold the advisory lock that allows one migration at a time.

    The lock is polled: a waiting statement would hold a snapshot, and `CREATE INDEX CONCURRENTLY`
    waits for every snapshot to end.
    """
    while True:
        with catalog.engine.connect() as connection:
            # Without a bound parameter, with which the portal keeps its snapshot until the next
            # statement.
            acquired = connection.exec_driver_sql(
                f"SELECT pg_try_advisory_xact_lock({ADVISORY_LOCK_ID})"
            )
            if acquired.scalar():
                yield
                return
        if time.monotonic() > deadline:
            raise Unavailable(
                "catalog_busy", "Another migration is running. Wait for it, then run this again."
            )
        time.sleep(SCHEMA_POLL_SECONDS)


def _upgrade(connection: Connection) -> None:
    # Imported here: most starts find the current schema, and loading Alembic takes a while.
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


def _known_revisions() -> list[str]:
    """Return the revisions of the migrations, oldest first: a file's name begins with its own."""
    return sorted(path.name.partition("_")[0] for path in MIGRATIONS.glob("versions/[0-9]*.py"))


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
