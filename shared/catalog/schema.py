"""Schema migrations while services run, and the check that a release fits the schema.

`placewise migrate` runs once per release, before its services start; the embedded Placewise
migrates at startup. Services only check the schema (`wait_for_schema`). The rules for migrations
are in docs/how-to/migrations.md.
"""

from __future__ import annotations

import contextlib
import logging
import random
import time
from collections.abc import Iterator
from pathlib import Path

from sqlalchemy import Connection, inspect, text
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from shared.catalog.database_errors import get_sqlstate, to_unavailable
from shared.catalog.file_checks import check_pages, opening
from shared.catalog.session import Catalog, TransactionTimeouts
from shared.config.private_files import FILE_MODE, make_private_folder
from shared.errors import Misconfigured, PlacewiseError, Unavailable

log = logging.getLogger(__name__)

MIGRATIONS = Path(__file__).parent / "migrations"
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
        catalog: The catalog.
        timeout_seconds: Time after which a migration that can't get a lock is not retried.

    Raises:
        Unavailable: `catalog_unavailable`, or `catalog_busy` after `timeout_seconds`.
        Misconfigured: As `opening` raises, for an SQLite file that can't be used.
    """
    try:
        if catalog.is_sqlite:
            with opening(catalog):
                check_pages(catalog)
                _migrate_sqlite(catalog)
        else:
            _migrate_postgres(catalog, time.monotonic() + timeout_seconds)
    except SQLAlchemyError as error:
        unavailable = to_unavailable(error)
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
        Unavailable: The catalog is not reachable after `seconds`.
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
            reason = to_unavailable(error) or error
            is_permanent = isinstance(reason, Misconfigured) and reason.code == "schema_too_new"
            if not isinstance(reason, PlacewiseError):
                raise
            if is_permanent or time.monotonic() > deadline:
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
