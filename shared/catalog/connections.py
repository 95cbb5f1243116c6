"""How a process talks to PostgreSQL: its pool, its patience, and when a statement is given up.

Every limit of the server is set inside the transaction (`SET LOCAL`), and nothing is prepared on
it: so a PgBouncer in transaction mode, which lends a server connection for one transaction, may
stand between. Not preparing also lets the planner see the values: a plan that is good for a map
with a million photos is bad for one with ten.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import psycopg
from psycopg.abc import RV, PQGen
from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine import URL

from shared.settings import Settings

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
