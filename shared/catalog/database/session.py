"""Database sessions: SQLite engine, pool and timeout settings, transactions and their retries.

`shared.catalog.database.postgres` has the engine for PostgreSQL.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import random
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy import create_engine, event
from sqlalchemy.engine import make_url
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session, sessionmaker

from shared.catalog.database.base import SQLITE_DISTANCE_FUNCTION
from shared.catalog.database.errors import ROLLBACK_SQLSTATES, get_sqlstate
from shared.geodesy import distance_m

log = logging.getLogger(__name__)

# idle_in_transaction_session_timeout: a transaction is idle only between two statements, which
# takes no time unless the process hangs. PostgreSQL then ends it and releases its locks.
PING_AFTER_IDLE_SECONDS = 60.0


@dataclass(frozen=True, slots=True)
class TransactionTimeouts:
    """Timeouts inside a PostgreSQL transaction; SQLite has none."""

    statement_seconds: float
    """Statement timeout (SQLSTATE 57014); 0 for none."""
    lock_seconds: float
    """Lock timeout (SQLSTATE 55P03)."""

    def sql(self) -> str:
        return (
            f"SET LOCAL statement_timeout = {self.statement_seconds * 1000:.0f};"
            f"SET LOCAL lock_timeout = {self.lock_seconds * 1000:.0f};"
            f"SET LOCAL idle_in_transaction_session_timeout = {PING_AFTER_IDLE_SECONDS * 1000:.0f}"
        )


# Where an abort costs more than waiting.
BACKGROUND_TIMEOUTS = TransactionTimeouts(statement_seconds=60.0, lock_seconds=60.0)
# Where a client waits for the response.
REQUEST_TIMEOUTS = TransactionTimeouts(statement_seconds=5.0, lock_seconds=3.0)
# For statements that read whole tables.
NO_TIMEOUTS = TransactionTimeouts(statement_seconds=0, lock_seconds=60.0)


@dataclass(frozen=True, slots=True)
class PoolConfig:
    """Connection pool of a process. Durations in seconds."""

    name: str = "placewise"
    """`application_name`, shown in `pg_stat_activity`."""
    size: int = 10
    overflow: int = 20
    """Temporary connections beyond `size`."""
    wait_seconds: float = 3.0
    """Wait for a free connection, then sqlalchemy.exc.TimeoutError."""
    connect_seconds: float = 3.0


# A longer wait for SQLite's single write lock is caused by a bug, not by load.
SQLITE_BUSY_SECONDS = 60

MAX_TRANSACTION_ATTEMPTS = 5  # of a transaction that PostgreSQL rolls back (deadlock, conflict)
RETRY_BASE_SECONDS = 0.05  # doubled after each attempt

T = TypeVar("T")


class CommitSignal:
    """Counts the commits of a server that changed rows, and wakes threads that wait for one."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.count = 0
        self.announce: Callable[[], object] = lambda: None
        """Called after each commit of this process, to tell the other one of the server."""

    def count_one(self) -> None:
        """Count a commit of this process or the other one."""
        with self._changed:
            self.count += 1
            self._changed.notify_all()

    def wait(self, count: int, seconds: float) -> None:
        """Wait until the count differs from `count`, at most `seconds`."""
        with self._changed:
            self._changed.wait_for(lambda: self.count != count, seconds)


class Catalog:
    """Opens sessions on one database.

    `read()` opens a read-only session on a consistent snapshot; `write()` commits at the end of its
    block and rolls back when it raises; `run(unit)` is a `write()` that is retried after a
    deadlock. Objects stay readable after the block. Database errors raise SQLAlchemyError;
    `shared.catalog.database.errors` decides which of them are outages.
    """

    def __init__(
        self,
        url: str,
        pool: PoolConfig = PoolConfig(),
        limits: TransactionTimeouts = BACKGROUND_TIMEOUTS,
    ) -> None:
        self.url = make_url(url)
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        if self.is_sqlite:
            self.engine = create_engine(
                self.url, connect_args={"timeout": SQLITE_BUSY_SECONDS, "check_same_thread": False}
            )
            event.listen(self.engine, "connect", _prepare_sqlite)
            event.listen(self.engine, "begin", _begin_sqlite)
        else:
            # Imported here, because psycopg takes a while to load.
            from shared.catalog.database.postgres import make_postgres_engine

            self.engine = make_postgres_engine(self.url, pool)
        self._sessions = sessionmaker(expire_on_commit=False)
        self._bind(limits)
        # SQLite has one writer: among threads a lock does not poll, unlike SQLite's busy handler.
        self._sqlite_writer = threading.Lock()
        self.commits = CommitSignal()

    def with_timeouts(self, limits: TransactionTimeouts) -> Catalog:
        """Return a catalog on the same connection pool with other timeouts."""
        catalog = copy.copy(self)
        catalog._bind(limits)
        return catalog

    def _bind(self, limits: TransactionTimeouts) -> None:
        self.limits = limits
        self._reads, self._writes = (
            self.engine.execution_options(placewise_limits=limits, placewise_write=writes)
            for writes in (False, True)
        )
        self._once = self._reads.execution_options(placewise_once=True)

    @contextlib.contextmanager
    def read(self) -> Iterator[Session]:
        """Open a read-only session on one consistent snapshot."""
        with self._sessions(bind=self._reads) as session:
            yield session

    @contextlib.contextmanager
    def read_once(self) -> Iterator[Session]:
        """Open a session for one quick statement that reads: PostgreSQL begins no transaction."""
        with self._sessions(bind=self._once) as session:
            yield session

    @contextlib.contextmanager
    def write(self, *, is_heartbeat: bool = False) -> Iterator[Session]:
        """Open a session that commits at the end of the block. PostgreSQL: READ COMMITTED.

        A heartbeat ends no wait of a `ChangePoll`: it gives no process anything to do.
        """
        if not self.is_sqlite:
            with self._sessions(bind=self._writes) as session:
                yield session
                session.commit()
            return
        with self._sqlite_writer, self._sessions(bind=self._writes) as session:
            before = _changed_rows(session)
            yield session
            session.flush()
            changed = _changed_rows(session) != before
            session.commit()
        if changed and not is_heartbeat:
            self.commits.count_one()
            self.commits.announce()

    def run(self, unit: Callable[[Session], T]) -> T:
        """Run `unit` in a write transaction, commit, and return its result.

        For units that lock rows of several tables: when PostgreSQL rolls one back because of a
        deadlock or a serialization failure, the whole unit is retried, up to
        MAX_TRANSACTION_ATTEMPTS times. `unit` must therefore have no effects outside the session.
        Other errors are raised at once.
        """
        for attempt in range(MAX_TRANSACTION_ATTEMPTS - 1):
            try:
                with self.write() as session:
                    return unit(session)
            except DBAPIError as error:
                reason = ROLLBACK_SQLSTATES.get(get_sqlstate(error) or "")
                if reason is None:
                    raise
                log.info("%s: retrying %s", reason, unit.__qualname__)
            # Jitter, or the two transactions would conflict again.
            time.sleep(random.uniform(0.5, 1.0) * RETRY_BASE_SECONDS * 2**attempt)  # noqa: S311
        with self.write() as session:
            return unit(session)

    def wait_for_commit(self, stop: threading.Event, count: int, seconds: float) -> None:
        """Wait until `commits.count` differs from `count`, or `stop` is set; at most `seconds`."""
        deadline = time.monotonic() + seconds
        while self.commits.count == count and not stop.is_set() and time.monotonic() < deadline:
            self.commits.wait(count, STOP_CHECK_SECONDS)

    def close(self) -> None:
        """Close every pooled connection."""
        self.engine.dispose()


def _changed_rows(session: Session) -> int:
    """Rows that the session's SQLite connection has changed since it was opened."""
    connection: sqlite3.Connection = session.connection().connection.driver_connection  # type: ignore[assignment]
    return connection.total_changes


# The longest pause of a loop without changes: what depends on time alone, such as an expired lease,
# is seen then.
IDLE_SECONDS = 20.0
STOP_CHECK_SECONDS = 0.5


class ChangePoll:
    """Paces a loop that looks for work in the catalog.

    The processes that write to SQLite announce their commits: without one since the last look, the
    loop pauses up to IDLE_SECONDS. PostgreSQL, which others write to, is polled at the loop's
    interval.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._seen = -1
        self._look_at = 0.0

    def is_due(self, longest_seconds: float = IDLE_SECONDS) -> bool:
        """Return whether a loop that does not `wait` here has to look now, which counts as done."""
        commits, now = self._catalog.commits.count, time.monotonic()
        if self._catalog.is_sqlite and commits == self._seen and now < self._look_at:
            return False
        self._seen, self._look_at = commits, now + longest_seconds
        return True

    def wait(
        self, stop: threading.Event, interval_seconds: float, longest_seconds: float = IDLE_SECONDS
    ) -> None:
        """Pause after a look until the next one, at least for the interval unless `stop` is set."""
        stop.wait(interval_seconds)
        if self._catalog.is_sqlite:
            idle_seconds = longest_seconds - interval_seconds
            self._catalog.wait_for_commit(stop, self._seen, idle_seconds)
        self._seen = self._catalog.commits.count


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # `_begin_sqlite` begins transactions, not the driver
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode = WAL")
    # FULL: a committed upload survives a power failure, not only a killed process.
    cursor.execute("PRAGMA synchronous = FULL")
    cursor.execute("PRAGMA foreign_keys = ON")
    cursor.close()
    connection.create_function(SQLITE_DISTANCE_FUNCTION, 4, _distance_or_null, deterministic=True)


def _distance_or_null(*degrees: float | None) -> float | None:
    known = [value for value in degrees if value is not None]
    return distance_m(*known) if len(known) == len(degrees) else None


def _begin_sqlite(connection: Any) -> None:
    # IMMEDIATE acquires the write lock at once: otherwise a transaction that reads before it writes
    # fails when another one writes in between.
    writes = connection.get_execution_options().get("placewise_write", True)
    if connection.info.get("placewise_write") != writes:
        connection.exec_driver_sql(f"PRAGMA query_only = {'OFF' if writes else 'ON'}")
        connection.info["placewise_write"] = writes
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
