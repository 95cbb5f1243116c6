"""PostgreSQL databases that tests take one after another: to empty one costs a tenth of a copy."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import psycopg
from psycopg import sql
from sqlalchemy.engine import make_url

import shared.catalog.tables  # noqa: F401 (all of them)
from shared.catalog.database.base import Base
from tests.support.servers import PostgresServer

# What migrations have written, and no test changes but in a database of its own.
KEPT = {"alembic_version"}
LEAVE_SECONDS = 0.5  # a closed connection is gone a moment later
LOCK_TIMEOUT = "SET lock_timeout = '1s'"
OTHERS = """SELECT count(*) FROM pg_stat_activity
    WHERE datname = current_database() AND pid <> pg_backend_pid()"""
# Tables and indexes with what they are made of, and settings: all that a test could leave changed.
SHAPE = """SELECT
    (SELECT string_agg(c.oid || c.relname || coalesce(i.indisvalid::text, ''), ',' ORDER BY c.oid)
        FROM pg_class c LEFT JOIN pg_index i ON i.indexrelid = c.oid
        WHERE c.relnamespace = 'public'::regnamespace),
    (SELECT count(*) FROM pg_attribute a JOIN pg_class c ON c.oid = a.attrelid
        WHERE c.relnamespace = 'public'::regnamespace AND NOT a.attisdropped),
    (SELECT count(*) FROM pg_trigger),
    (SELECT string_agg(setconfig::text, ',') FROM pg_db_role_setting s
        JOIN pg_database d ON d.oid = s.setdatabase WHERE d.datname = current_database()),
    (SELECT string_agg(version_num, ',') FROM alembic_version)"""


class SpareDatabases:
    """Migrated, empty databases. One that can't be made as it was is not given out again."""

    def __init__(self, server: PostgresServer, template: str) -> None:
        self._server = server
        self._template = template
        self._spare: list[tuple[str, object]] = []

    @contextlib.contextmanager
    def one(self) -> Iterator[str]:
        """The SQLAlchemy URL of an empty catalog, the block's own."""
        url, shape = self._spare.pop() if self._spare else self._new()
        yield url
        if self._emptied(url, shape):
            self._spare.append((url, shape))

    def _new(self) -> tuple[str, object]:
        url = self._server.new_database(self._template)
        with _connected(url) as connection:
            return url, _shape(connection)

    def _emptied(self, url: str, shape: object) -> bool:
        """False where someone still uses it, its tables are others, or it may not be emptied."""
        tables = [t.name for t in reversed(Base.metadata.sorted_tables) if t.name not in KEPT]
        with _connected(url) as connection:
            if not _left_alone(connection) or _shape(connection) != shape:
                return False
            try:
                connection.execute(LOCK_TIMEOUT)
                with connection.transaction():
                    # A table names itself, or two name each other: keys are looked at in the end.
                    connection.execute("SET LOCAL session_replication_role = replica")
                    for table in tables:
                        connection.execute(sql.SQL("DELETE FROM {}").format(sql.Identifier(table)))
            except (psycopg.errors.LockNotAvailable, psycopg.errors.InsufficientPrivilege):
                return False  # the second: on a named server, whose user may be nobody special
        return True


def _connected(url: str) -> psycopg.Connection:
    plain = make_url(url).set(drivername="postgresql").render_as_string(hide_password=False)
    return psycopg.connect(plain, autocommit=True)


def _left_alone(connection: psycopg.Connection) -> bool:
    deadline = time.monotonic() + LEAVE_SECONDS
    while connection.execute(OTHERS).fetchone() != (0,):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


def _shape(connection: psycopg.Connection) -> object:
    return connection.execute(SHAPE).fetchone()
