"""PostgreSQL engine: connections that detect an unresponsive server, and transaction timeouts.

Timeouts are set inside the transaction (`SET LOCAL`) and no statements are prepared on the server,
so that PgBouncer in transaction mode works. Without prepared statements the planner also sees the
values: a plan that is good for a map with a million photos is bad for one with ten.

The driver is in autocommit mode, and connections are pinged here: `BEGIN` goes out in one round
trip with the timeouts, past SQLAlchemy's execution of statements, and only a connection that was
unused for a while is pinged. The driver's own `BEGIN` and SQLAlchemy's `pool_pre_ping` would cost
every transaction a round trip more each.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import psycopg
from psycopg.abc import RV, PQGen
from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine import URL
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import InvalidatePoolError
from sqlalchemy.pool import ConnectionPoolEntry

from shared.catalog.database.session import PoolConfig, TransactionTimeouts

# Grace for the server's own timeout error to arrive; after it the server counts as unresponsive.
ANSWER_MARGIN_SECONDS = 2.0
PING_TIMEOUT_SECONDS = 5.0  # a busy server may take seconds for a BEGIN
# A connection that was in use a moment ago is not pinged: a server that went away since then would
# have ended that request as well.
PING_AFTER_UNUSED_SECONDS = 1.0
DEFAULT_PORT = 5432
BEGIN_SNAPSHOT = "BEGIN ISOLATION LEVEL REPEATABLE READ, READ ONLY"
USED_AT = "placewise_used_at"  # of a pooled connection: when it was returned, in monotonic seconds
POOL = "placewise_pool"  # of a pooled connection: the pool that made it

# Detects a peer that disappeared without closing the connection (lost network or machine).
TCP_KEEPALIVE_OPTIONS = {
    "keepalives": 1,
    "keepalives_idle": 10,  # seconds
    "keepalives_interval": 3,  # seconds
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,  # milliseconds that sent bytes may stay unacknowledged
}


class TimeoutConnection(psycopg.Connection[Any]):
    """A connection with a client-side timeout for responses.

    The server's own timeouts need a working server: one that is frozen, or whose disk hangs, keeps
    its connections open and does not respond.
    """

    answer_seconds: float | None = PING_TIMEOUT_SECONDS
    """Response timeout; None for no timeout."""
    limits: TransactionTimeouts | None = None
    """Those of the next transaction."""
    begin = ""
    """The statement that begins it."""

    def wait(self, gen: PQGen[RV], interval: float = 0.1, timeout: float | None = None) -> RV:
        try:
            return super().wait(gen, interval, self.answer_seconds if timeout is None else timeout)
        except psycopg.OperationalError:
            if self.pgconn.transaction_status == psycopg.pq.TransactionStatus.ACTIVE:
                self.pgconn.finish()  # a late response must not be read as that of another query
            raise


def make_postgres_engine(url: URL, pool: PoolConfig) -> Engine:
    """Create the engine.

    The execution option `placewise_limits` sets the TransactionTimeouts of its transactions;
    `placewise_write=False` makes them read-only, on one snapshot; `placewise_once` begins none.
    """
    engine = create_engine(
        url,
        pool_size=pool.size,
        max_overflow=pool.overflow,
        pool_timeout=pool.wait_seconds,
        creator=_connector(url, pool),
    )
    event.listen(engine, "begin", _choose_begin)
    engine.dialect.do_begin = _begin  # type: ignore[assignment,method-assign]

    def note_pool(_connection: object, record: ConnectionPoolEntry) -> None:
        record.info[POOL] = engine.pool

    def check_in(connection: TimeoutConnection | None, record: ConnectionPoolEntry) -> None:
        if connection is None:  # it was invalidated
            return
        connection.answer_seconds = PING_TIMEOUT_SECONDS
        record.info[USED_AT] = time.monotonic()
        if record.info[POOL] is not engine.pool:  # in use while the engine was disposed of
            record.close()

    event.listen(engine, "connect", note_pool)
    event.listen(engine, "checkin", check_in)

    def ping(connection: Any, record: ConnectionPoolEntry, _proxy: object) -> None:
        """Replace all connections if this one, which was not used for a while, is dead."""
        used_at = record.info.get(USED_AT)
        if used_at is None or time.monotonic() - used_at < PING_AFTER_UNUSED_SECONDS:
            return
        try:
            engine.dialect.do_ping(connection)
        except psycopg.Error as error:
            raise InvalidatePoolError from error

    event.listen(engine, "checkout", ping)
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
        try:
            return TimeoutConnection.connect(autocommit=True, prepare_threshold=None, **arguments)
        except psycopg.OperationalError as error:
            # libpq names neither the database nor, for some failures, the host.
            local = url.query.get("host", "the local socket")
            address = f"{url.host}:{url.port or DEFAULT_PORT}" if url.host else local
            target = f"database {url.database or 'of the user'} at {address}"
            raise type(error)(f"{target}: {error}") from error

    return connect


def _choose_begin(connection: Connection) -> None:
    options = connection.get_execution_options()
    driver = connection.connection.driver_connection
    assert isinstance(driver, TimeoutConnection)
    driver.limits, driver.begin = options.get("placewise_limits"), ""
    if options.get("isolation_level") != "AUTOCOMMIT" and not options.get("placewise_once"):
        driver.begin = "BEGIN" if options.get("placewise_write", True) else BEGIN_SNAPSHOT


def _begin(connection: DBAPIConnection) -> None:
    """Begin the transaction; SQLAlchemy wraps what is raised here, not what its events raise."""
    driver = connection.driver_connection
    limits = driver.limits
    if not driver.autocommit:  # as SQLAlchemy leaves a connection after AUTOCOMMIT
        driver.autocommit = True
    if driver.begin:
        driver.answer_seconds = PING_TIMEOUT_SECONDS  # it waits for no lock
        driver.execute(driver.begin if limits is None else f"{driver.begin};{limits.sql()}")
    driver.answer_seconds = None
    if limits is not None and limits.statement_seconds:
        driver.answer_seconds = limits.statement_seconds + ANSWER_MARGIN_SECONDS
