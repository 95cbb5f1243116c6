"""Database sessions: engine, connection pool, timeouts, transactions and their retries.

Timeouts are set inside the transaction (`SET LOCAL`) and no statements are prepared on the server,
so that PgBouncer in transaction mode works. Without prepared statements the planner also sees the
values: a plan that is good for a map with a million photos is bad for one with ten.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import random
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import psycopg
from psycopg.abc import RV, PQGen
from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session, sessionmaker

from shared.catalog.base import SQLITE_DISTANCE_FUNCTION
from shared.catalog.database_errors import ROLLBACK_SQLSTATES, get_sqlstate
from shared.config.settings import Settings
from shared.geodesy import distance_m

log = logging.getLogger(__name__)

# idle_in_transaction_session_timeout: a transaction is idle only between two statements, which
# takes no time unless the process hangs. PostgreSQL then ends it and releases its locks.
PING_AFTER_IDLE_SECONDS = 60.0
# Grace for the server's own timeout error to arrive; after it the server counts as unresponsive.
ANSWER_MARGIN_SECONDS = 2.0
PING_TIMEOUT_SECONDS = 2.0

# Detects a peer that disappeared without closing the connection (lost network or machine).
TCP_KEEPALIVE_OPTIONS = {
    "keepalives": 1,
    "keepalives_idle": 10,  # seconds
    "keepalives_interval": 3,  # seconds
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,  # milliseconds that sent bytes may stay unacknowledged
}


@dataclass(frozen=True, slots=True)
class TransactionTimeouts:
    """Timeouts inside a PostgreSQL transaction; SQLite has none."""

    statement_seconds: float = 60.0
    """Statement timeout (SQLSTATE 57014); 0 for none."""
    lock_seconds: float = 60.0
    """Lock timeout (SQLSTATE 55P03)."""

    @classmethod
    def for_requests(cls, settings: Settings) -> Self:
        """Return the timeouts for requests, where a client waits for the response."""
        return cls(settings.database_statement_seconds, settings.database_lock_seconds)

    @classmethod
    def for_background(cls, settings: Settings) -> Self:
        """Return the timeouts for background work, where an abort costs more than waiting."""
        return cls(settings.database_work_seconds, settings.database_work_seconds)

    def sql(self) -> str:
        return (
            f"SET LOCAL statement_timeout = {self.statement_seconds * 1000:.0f};"
            f"SET LOCAL lock_timeout = {self.lock_seconds * 1000:.0f};"
            f"SET LOCAL idle_in_transaction_session_timeout = {PING_AFTER_IDLE_SECONDS * 1000:.0f}"
        )


# For statements that read whole tables.
NO_TIMEOUTS = TransactionTimeouts(statement_seconds=0)


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

    @classmethod
    def from_settings(cls, settings: Settings, service: str) -> Self:
        return cls(
            name=f"placewise-{service}",
            size=settings.database_pool_size,
            overflow=settings.database_pool_overflow,
            wait_seconds=settings.database_pool_wait_seconds,
            connect_seconds=settings.database_connect_seconds,
        )


class TimeoutConnection(psycopg.Connection[Any]):
    """A connection with a client-side timeout for responses.

    The server's own timeouts need a working server: one that is frozen, or whose disk hangs, keeps
    its connections open and does not respond.
    """

    answer_seconds: float | None = PING_TIMEOUT_SECONDS
    """Response timeout; None for no timeout."""

    def wait(self, gen: PQGen[RV], interval: float = 0.1, timeout: float | None = None) -> RV:
        try:
            return super().wait(gen, interval, self.answer_seconds if timeout is None else timeout)
        except psycopg.OperationalError:
            if self.pgconn.transaction_status == psycopg.pq.TransactionStatus.ACTIVE:
                self.pgconn.finish()  # a late response must not be read as that of another query
            raise


def make_postgres_engine(url: URL, pool: PoolConfig) -> Engine:
    """Create the engine.

    The execution option `placewise_limits` sets the TransactionTimeouts of its transactions.
    """
    engine = create_engine(
        url,
        pool_size=pool.size,
        max_overflow=pool.overflow,
        pool_timeout=pool.wait_seconds,
        pool_pre_ping=True,
        creator=_connector(url, pool),
    )
    event.listen(engine, "begin", _set_timeouts)
    event.listen(engine, "checkin", _limit_ping)
    return engine


def _connector(url: URL, pool: PoolConfig) -> Callable[[], TimeoutConnection]:
    arguments: dict[str, Any] = {
        "application_name": pool.name,
        # psycopg accepts whole seconds from 2 on.
        "connect_timeout": max(2, round(pool.connect_seconds)),
        **TCP_KEEPALIVE_OPTIONS,
        **url.translate_connect_args(username="user", database="dbname"),
        **url.query,  # the operator's options override the others
    }

    def connect() -> TimeoutConnection:
        return TimeoutConnection.connect(prepare_threshold=None, **arguments)

    return connect


def _set_timeouts(connection: Connection) -> None:
    limits: TransactionTimeouts | None = connection.get_execution_options().get("placewise_limits")
    driver = connection.connection.driver_connection
    assert isinstance(driver, TimeoutConnection)
    driver.answer_seconds = None
    if limits is None:
        return
    if limits.statement_seconds:
        driver.answer_seconds = limits.statement_seconds + ANSWER_MARGIN_SECONDS
    if not driver.autocommit:  # SET LOCAL needs a transaction
        connection.exec_driver_sql(limits.sql())


def _limit_ping(connection: TimeoutConnection | None, _record: object) -> None:
    if connection is not None:  # None: the connection was invalidated
        connection.answer_seconds = PING_TIMEOUT_SECONDS


# A longer wait for SQLite's single write lock is caused by a bug, not by load.
SQLITE_BUSY_SECONDS = 60

MAX_TRANSACTION_ATTEMPTS = 5  # of a transaction that PostgreSQL rolls back (deadlock, conflict)
RETRY_BASE_SECONDS = 0.05  # doubled after each attempt

T = TypeVar("T")


class Catalog:
    """Opens sessions on one database.

    `read()` opens a read-only session on a consistent snapshot; `write()` commits at the end of its
    block and rolls back when it raises; `run(unit)` is a `write()` that is retried after a
    deadlock. Objects stay readable after the block. Database errors raise SQLAlchemyError;
    `shared.catalog.database_errors` tells which of them are outages.
    """

    def __init__(
        self,
        url: str,
        pool: PoolConfig = PoolConfig(),
        limits: TransactionTimeouts = TransactionTimeouts(),
    ) -> None:
        self.url = make_url(url)
        self.limits = limits
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        if self.is_sqlite:
            self.engine = create_engine(
                self.url, connect_args={"timeout": SQLITE_BUSY_SECONDS, "check_same_thread": False}
            )
            event.listen(self.engine, "connect", _prepare_sqlite)
            event.listen(self.engine, "begin", _begin_sqlite)
        else:
            self.engine = make_postgres_engine(self.url, pool)
        self._sessions = sessionmaker(expire_on_commit=False)
        # SQLite has one writer: a lock is fair and does not poll, unlike SQLite's busy handler.
        self._sqlite_writer = threading.Lock()

    def with_timeouts(self, limits: TransactionTimeouts) -> Catalog:
        """Return a catalog on the same connection pool with other timeouts."""
        catalog = copy.copy(self)
        catalog.limits = limits
        return catalog

    @contextlib.contextmanager
    def read(self) -> Iterator[Session]:
        """Open a read-only session on one consistent snapshot."""
        isolation: dict[str, Any] = (
            {}
            if self.is_sqlite
            else {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
        )
        with self._session(placewise_write=False, **isolation) as session:
            yield session

    @contextlib.contextmanager
    def write(self) -> Iterator[Session]:
        """Open a session that commits at the end of the block. PostgreSQL: READ COMMITTED."""
        writer_lock = self._sqlite_writer if self.is_sqlite else contextlib.nullcontext()
        with writer_lock, self._session(placewise_write=True) as session:
            yield session
            session.commit()

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

    def close(self) -> None:
        """Close every pooled connection."""
        self.engine.dispose()

    def _session(self, **options: Any) -> Session:
        return self._sessions(
            bind=self.engine.execution_options(placewise_limits=self.limits, **options)
        )


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
    connection.exec_driver_sql(f"PRAGMA query_only = {'OFF' if writes else 'ON'}")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
