"""The one session factory and the one place that commits."""

from __future__ import annotations

import contextlib
import copy
import logging
import random
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from sqlalchemy import create_engine, event
from sqlalchemy.engine import make_url
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session, sessionmaker

from shared.catalog.away import ROLLBACK_SQLSTATES, get_sqlstate
from shared.catalog.base import SQLITE_DISTANCE_FUNCTION
from shared.catalog.connections import PoolConfig, TransactionTimeouts, make_postgres_engine
from shared.geodesy import distance_m

log = logging.getLogger(__name__)

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
    `shared.catalog.away` says what of it is an outage.
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
