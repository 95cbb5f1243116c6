"""The one session factory and the one place that commits."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from alembic import command
from alembic.config import Config
from sqlalchemy import create_engine, event
from sqlalchemy.engine import make_url
from sqlalchemy.orm import Session, sessionmaker

from shared.catalog.base import SQLITE_DISTANCE
from shared.geodesy import distance_m

MIGRATIONS = Path(__file__).parent / "migrations"

# A writer that waits this long for SQLite's single write lock has met a bug, not a queue.
SQLITE_BUSY_SECONDS = 60


class Catalog:
    """Opens sessions on one database.

    `read()` gives a consistent snapshot and never writes; `write()` commits when its block ends
    and rolls back when it raises. Objects stay readable after the block.
    """

    def __init__(self, url: str) -> None:
        self.url = make_url(url)
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
            self.engine = create_engine(self.url, pool_size=10, max_overflow=30, pool_pre_ping=True)
        self._sessions = sessionmaker(expire_on_commit=False)
        # SQLite has one writer: queueing here is fair and does not spin as its busy handler does.
        self._sqlite_writer = threading.Lock()

    @contextlib.contextmanager
    def read(self) -> Iterator[Session]:
        """A session on one consistent snapshot; what it changes is thrown away."""
        isolation: dict[str, Any] = (
            {}
            if self.is_sqlite
            else {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
        )
        engine = self.engine.execution_options(placewise_write=False, **isolation)
        with self._sessions(bind=engine) as session:
            yield session

    @contextlib.contextmanager
    def write(self) -> Iterator[Session]:
        """A session that commits when the block ends. PostgreSQL: READ COMMITTED."""
        engine = self.engine.execution_options(placewise_write=True)
        turn = self._sqlite_writer if self.is_sqlite else contextlib.nullcontext()
        with turn, self._sessions(bind=engine) as session:
            yield session
            session.commit()

    def migrate(self) -> None:
        """Bring the schema to the newest version; safe to call from several processes at once."""
        if self.is_sqlite and self.url.database:
            Path(self.url.database).parent.mkdir(parents=True, exist_ok=True)
        config = Config()
        config.set_main_option("script_location", str(MIGRATIONS))
        with self.engine.execution_options(placewise_write=True).begin() as connection:
            if not self.is_sqlite:
                # One migration at a time; the number is "plac" in ASCII.
                connection.exec_driver_sql("SELECT pg_advisory_xact_lock(1886151011)")
            config.attributes["connection"] = connection
            command.upgrade(config, "head")

    def close(self) -> None:
        """Close every pooled connection."""
        self.engine.dispose()


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
    connection.create_function(SQLITE_DISTANCE, 4, _distance_or_null, deterministic=True)


def _distance_or_null(*degrees: float | None) -> float | None:
    known = [value for value in degrees if value is not None]
    return distance_m(*known) if len(known) == len(degrees) else None


def _begin_sqlite(connection: Any) -> None:
    # IMMEDIATE takes the write lock at once: a transaction that reads before it writes can then
    # never fail half way because another one wrote in between.
    writes = connection.get_execution_options().get("placewise_write", True)
    connection.exec_driver_sql(f"PRAGMA query_only = {'OFF' if writes else 'ON'}")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
