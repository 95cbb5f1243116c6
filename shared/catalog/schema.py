"""The catalog's schema: bringing it up to date beside a running fleet, and knowing one's own.

`placewise migrate` runs once per release, before its services start; the embedded Placewise does it
itself. Services only look (`wait_for_schema`). docs/how-to/migrations.md has the rules.
"""

from __future__ import annotations

import contextlib
import logging
import random
import time
from collections.abc import Iterator
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from sqlalchemy import inspect, text
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from shared.catalog.database_errors import get_sqlstate, to_unavailable
from shared.catalog.file_checks import check_pages, opening
from shared.catalog.session import Catalog, TransactionTimeouts
from shared.config.private_files import FILE_MODE, make_private_folder
from shared.errors import Misconfigured, PlacewiseError, Unavailable

log = logging.getLogger(__name__)

MIGRATIONS = Path(__file__).parent / "migrations"
ADVISORY_LOCK_ID = 1886151011  # "plac" in ASCII

# Whoever asks for a table's strongest lock makes everyone behind him wait as long as he does: less
# than a request waits for a lock. A statement that has its lock may take any time.
MIGRATION_TIMEOUTS = TransactionTimeouts(statement_seconds=0, lock_seconds=1.0)
LOCK_NOT_AVAILABLE = "55P03"
DEADLOCK = "40P01"
MIGRATION_TIMEOUT_SECONDS = 300.0
LOCK_RETRY_SECONDS = 1.0
SCHEMA_POLL_SECONDS = 0.5


def migrate(catalog: Catalog, timeout_seconds: float = MIGRATION_TIMEOUT_SECONDS) -> None:
    """Bring the schema to this release's; safe from several processes at once, beside a fleet.

    On PostgreSQL each migration is a transaction of its own, which gives up after a second when it
    can't have a lock and is tried again: traffic goes on meanwhile. Raises Unavailable
    (`catalog_unavailable`; `catalog_busy` when a lock was not to be had for `timeout_seconds`)
    and Misconfigured (`schema_too_new`, and for a file that can't be used as `opening` does).
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
    """Raise Misconfigured unless this release can work with the schema that is there.

    `schema_outdated`: older than this release needs. `schema_too_new`: a later release has changed
    it in a way that this one does not understand; what was only added does no harm.
    """
    scripts = ScriptDirectory.from_config(_config())
    known = {script.revision for script in scripts.walk_revisions()}
    head = scripts.get_current_head()
    present, understood_from = _read_schema_revision(catalog)
    if present == head:
        return
    if present is None or present in known:
        raise Misconfigured(
            "schema_outdated",
            f"The catalog's schema is {present or 'not there'}, and this release needs {head}. "
            "Run `placewise migrate` once.",
            present=present,
            needed=head,
        )
    if understood_from not in known:
        raise Misconfigured(
            "schema_too_new",
            f"The catalog's schema is {present}, which releases before {understood_from} don't "
            f"understand; this one ends at {head}. Start the newer release.",
            present=present,
            needed=head,
        )
    log.info("the catalog's schema is %s, newer than this release's %s", present, head)


def wait_for_schema(catalog: Catalog, seconds: float) -> None:
    """Until the catalog answers with a schema that this release can work with. SQLite, which only
    processes of one machine share, is brought up to date instead.

    After `seconds` raises what is still in the way: Unavailable, or Misconfigured as `check_schema`
    does. `schema_too_new` is raised at once: waiting does not help.
    """
    if catalog.is_sqlite:
        migrate(catalog)
        return
    deadline, told = time.monotonic() + seconds, False
    while True:
        try:
            check_schema(catalog)
            return
        except (Misconfigured, SQLAlchemyError) as error:
            reason = to_unavailable(error) or error
            hopeless = isinstance(reason, Misconfigured) and reason.code == "schema_too_new"
            if not isinstance(reason, PlacewiseError):
                raise
            if hopeless or time.monotonic() > deadline:
                raise reason from error
            if not told:
                told = True
                log.warning("waiting up to %g s: %s", seconds, reason.detail)
        time.sleep(SCHEMA_POLL_SECONDS)


def _read_schema_revision(catalog: Catalog) -> tuple[str | None, str | None]:
    """The schema's revision, and the oldest one whose release understands it."""
    with catalog.read() as session:
        tables = set(inspect(session.connection()).get_table_names())
        if "alembic_version" not in tables:
            return None, None
        present = session.scalar(text("SELECT version_num FROM alembic_version"))
        if "schema_compatibility" not in tables:
            return present, None
        return present, session.scalar(text("SELECT understood_from FROM schema_compatibility"))


def _migrate_sqlite(catalog: Catalog) -> None:
    """In one transaction, which keeps every other process out."""
    if catalog.url.database:
        file = Path(catalog.url.database)
        make_private_folder(file.parent)
        file.touch(FILE_MODE)  # SQLite gives its -wal and -shm files the same mode
    with catalog.engine.execution_options(placewise_write=True).begin() as connection:
        config = _config()
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


def _migrate_postgres(catalog: Catalog, deadline: float) -> None:
    engine = catalog.engine.execution_options(placewise_limits=MIGRATION_TIMEOUTS)
    with _migration_lock(catalog, deadline):
        while True:
            try:
                with engine.connect() as connection:
                    config = _config()
                    config.attributes["connection"] = connection
                    command.upgrade(config, "head")
                return
            except DBAPIError as error:
                in_the_way = get_sqlstate(error) in (LOCK_NOT_AVAILABLE, DEADLOCK)
                if not in_the_way or time.monotonic() > deadline:
                    raise
                log.info("traffic holds a lock that a migration needs: trying again")
            time.sleep(LOCK_RETRY_SECONDS * random.uniform(0.5, 1.5))  # noqa: S311


@contextlib.contextmanager
def _migration_lock(catalog: Catalog, deadline: float) -> Iterator[None]:
    """One migration at a time. The lock is tried, not waited for: a waiting statement holds a
    snapshot, and `CREATE INDEX CONCURRENTLY` waits for every snapshot to end."""
    while True:
        with catalog.engine.connect() as connection:
            # Without a parameter: a portal with one keeps its snapshot until the next statement.
            tried = connection.exec_driver_sql(
                f"SELECT pg_try_advisory_xact_lock({ADVISORY_LOCK_ID})"
            )
            if tried.scalar():
                yield
                return
        if time.monotonic() > deadline:
            raise Unavailable(
                "catalog_busy", "Another migration is running. Wait for it, then run this again."
            )
        time.sleep(SCHEMA_POLL_SECONDS)


def _config() -> Config:
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    return config
