"""How a process talks to PostgreSQL: its pool, its patience, and when a statement is given up.

Every limit of the server is set inside the transaction (`SET LOCAL`), and nothing is prepared on
it: so a PgBouncer in transaction mode, which lends a server connection for one transaction, may
stand between. Not preparing also lets the planner see the values: a plan that is good for a map
with a million photos is bad for one with ten.

The one session factory and the one place that commits.
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

# A transaction waits for its own process only between two statements: that takes no time, unless
# the process hangs. Its locks are then taken from it.
PING_AFTER_IDLE_SECONDS = 60.0
# What the server's own limit may take to reach us; after that the server itself is silent.
ANSWER_MARGIN_SECONDS = 2.0
PING_TIMEOUT_SECONDS = 2.0

# A peer that vanished without a word (a cut network, a lost machine) is found out by these.
TCP_KEEPALIVE_OPTIONS = {
    "keepalives": 1,
    "keepalives_idle": 10,  # seconds
    "keepalives_interval": 3,  # seconds
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,  # milliseconds that sent bytes may stay unacknowledged
}


@dataclass(frozen=True, slots=True)
class TransactionTimeouts:
    """How long PostgreSQL may take inside a transaction; SQLite knows no such limits."""

    statement_seconds: float = 60.0
    """For one statement, then it is ended (SQLSTATE 57014); 0: for as long as it takes."""
    lock_seconds: float = 60.0
    """Waiting for one lock, then the statement is ended (SQLSTATE 55P03)."""

    @classmethod
    def for_requests(cls, settings: Settings) -> Self:
        """Someone waits for the answer."""
        return cls(settings.database_statement_seconds, settings.database_lock_seconds)

    @classmethod
    def for_background(cls, settings: Settings) -> Self:
        """In the background, where giving up costs more than waiting."""
        return cls(settings.database_work_seconds, settings.database_work_seconds)

    def sql(self) -> str:
        return (
            f"SET LOCAL statement_timeout = {self.statement_seconds * 1000:.0f};"
            f"SET LOCAL lock_timeout = {self.lock_seconds * 1000:.0f};"
            f"SET LOCAL idle_in_transaction_session_timeout = {PING_AFTER_IDLE_SECONDS * 1000:.0f}"
        )


# Of a walk over everything.
NO_TIMEOUTS = TransactionTimeouts(statement_seconds=0)


@dataclass(frozen=True, slots=True)
class PoolConfig:
    """A process's connections to PostgreSQL. Durations in seconds."""

    name: str = "placewise"
    """`application_name`: who it is, in `pg_stat_activity`."""
    size: int = 10
    overflow: int = 20
    """Connections beyond `size` while they are needed."""
    wait_seconds: float = 3.0
    """For a free connection, then sqlalchemy.exc.TimeoutError."""
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
    """Gives the server up when it is silent for `answer_seconds`.

    The server's own limits need a server that works: a frozen one, or one whose disk hangs, keeps
    its connections open and says nothing.
    """

    answer_seconds: float | None = PING_TIMEOUT_SECONDS
    """None: for as long as it takes."""

    def wait(self, gen: PQGen[RV], interval: float = 0.1, timeout: float | None = None) -> RV:
        try:
            return super().wait(gen, interval, self.answer_seconds if timeout is None else timeout)
        except psycopg.OperationalError:
            if self.pgconn.transaction_status == psycopg.pq.TransactionStatus.ACTIVE:
                self.pgconn.finish()  # an answer may still come: no one may take it for theirs
            raise


def make_postgres_engine(url: URL, pool: PoolConfig) -> Engine:
    """The engine; transactions run under `Limits` when the execution option `placewise_limits`
    says so."""
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
        # psycopg takes whole seconds, and no less than 2.
        "connect_timeout": max(2, round(pool.connect_seconds)),
        **TCP_KEEPALIVE_OPTIONS,
        **url.translate_connect_args(username="user", database="dbname"),
        **url.query,  # what the operator says comes last
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
    if not driver.autocommit:  # where there is no transaction to be limited
        connection.exec_driver_sql(limits.sql())


def _limit_ping(connection: TimeoutConnection | None, _record: object) -> None:
    if connection is not None:  # None: it was found broken
        connection.answer_seconds = PING_TIMEOUT_SECONDS


# A writer that waits this long for SQLite's single write lock has met a bug, not a queue.
SQLITE_BUSY_SECONDS = 60

MAX_TRANSACTION_ATTEMPTS = 5  # of a unit that PostgreSQL sacrifices to others
RETRY_BASE_SECONDS = 0.05  # doubled each time

T = TypeVar("T")


class Catalog:
    """Opens sessions on one database.

    `read()` gives a consistent snapshot and never writes; `write()` commits when its block ends
    and rolls back when it raises; `run(unit)` is a `write()` that begins anew after a deadlock.
    Objects stay readable after the block. Whatever the database refuses raises SQLAlchemyError;
    `shared.catalog.database_errors` says what of it is an outage.
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
                self.url,
                connect_args={
                    "timeout": SQLITE_BUSY_SECONDS,
                    "check_same_thread": False,
                },
            )
            event.listen(self.engine, "connect", _prepare_sqlite)
            event.listen(self.engine, "begin", _begin_sqlite)
        else:
            self.engine = make_postgres_engine(self.url, pool)
        self._sessions = sessionmaker(expire_on_commit=False)
        # SQLite has one writer: queueing here is fair and does not spin as its busy handler does.
        self._sqlite_writer = threading.Lock()

    def with_timeouts(self, limits: TransactionTimeouts) -> Catalog:
        """The same connections, for transactions with other limits."""
        other = copy.copy(self)
        other.limits = limits
        return other

    @contextlib.contextmanager
    def read(self) -> Iterator[Session]:
        """A session on one consistent snapshot; what it changes is thrown away."""
        isolation: dict[str, Any] = (
            {}
            if self.is_sqlite
            else {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
        )
        with self._session(placewise_write=False, **isolation) as session:
            yield session

    @contextlib.contextmanager
    def write(self) -> Iterator[Session]:
        """A session that commits when the block ends. PostgreSQL: READ COMMITTED."""
        turn = self._sqlite_writer if self.is_sqlite else contextlib.nullcontext()
        with turn, self._session(placewise_write=True) as session:
            yield session
            session.commit()

    def run(self, unit: Callable[[Session], T]) -> T:
        """What `unit` returns, after its transaction is committed.

        For units that lock rows of several tables: where PostgreSQL ends one for another's sake
        (a deadlock, a serialization failure), the whole unit is run again, up to TRIES times. It
        begins from nothing each time: `unit` may change nothing but the session. Every other
        error is raised at once.
        """
        for attempt in range(MAX_TRANSACTION_ATTEMPTS - 1):
            try:
                with self.write() as session:
                    return unit(session)
            except DBAPIError as error:
                reason = ROLLBACK_SQLSTATES.get(get_sqlstate(error) or "")
                if reason is None:
                    raise
                log.info("%s: %s is run again", reason, unit.__qualname__)
            # Apart, or they meet again.
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
    connection.isolation_level = (
        None  # transactions are begun by `_begin_sqlite`, not by the driver
    )
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode = WAL")
    # FULL: a committed upload survives a power cut, not only a killed process.
    cursor.execute("PRAGMA synchronous = FULL")
    cursor.execute("PRAGMA foreign_keys = ON")
    cursor.close()
    connection.create_function(SQLITE_DISTANCE_FUNCTION, 4, _distance_or_null, deterministic=True)


def _distance_or_null(*degrees: float | None) -> float | None:
    known = [value for value in degrees if value is not None]
    return distance_m(*known) if len(known) == len(degrees) else None


def _begin_sqlite(connection: Any) -> None:
    # IMMEDIATE takes the write lock at once: a transaction that reads before it writes can then
    # never fail half way because another one wrote in between.
    writes = connection.get_execution_options().get("placewise_write", True)
    connection.exec_driver_sql(f"PRAGMA query_only = {'OFF' if writes else 'ON'}")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
