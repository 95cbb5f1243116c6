"""A forked `placewise` is what an executed one is."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import psutil
import pytest

from tests.support.processes import PLACEWISE, REPOSITORY, start
from tests.support.server import environment, run_command
from tests.support.servers.daemon import has_ended
from tests.support.waiting import wait_until

pytestmark = pytest.mark.servers


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["config", "--json"], 0),
        (["query", "here.jpg", "--server", "ftp://nowhere", "--json"], 1),
    ],
    ids=["done", "refused"],
)
def test_both_say_the_same(arguments: Sequence[str], code: int, tmp_path: Path) -> None:
    (tmp_path / "here.jpg").write_text("no photo")
    env = environment(tmp_path / "home", max_file_size=12345)
    forked, executed = (
        run_command(*arguments, env=env, cwd=tmp_path, executed=executed)
        for executed in (False, True)
    )
    assert forked.returncode == executed.returncode == code, forked.stderr
    assert (forked.stdout, forked.stderr) == (executed.stdout, executed.stderr)
    assert forked.stdout + forked.stderr


def test_each_draws_numbers_of_its_own(tmp_path: Path) -> None:
    """A fork begins with its parent's random state, too."""
    drawn = []
    for number in range(3):
        env = environment(tmp_path / str(number))
        ended = run_command("storage", "migrate", env=env, cwd=tmp_path)
        assert ended.returncode == 0, ended.stderr
        made = re.search(r"installation\s+([0-9a-f-]{36})", ended.stderr)
        assert made, ended.stderr
        drawn.append(made[1].rpartition("-")[2])  # what goes before it counts the time
    assert len(set(drawn)) == 3, drawn


def test_what_a_library_may_read_at_its_import_is_executed(tmp_path: Path) -> None:
    env = {**environment(tmp_path / "home"), "OMP_NUM_THREADS": "3"}
    with (tmp_path / "log").open("wb") as log:
        process = start([PLACEWISE, "config"], env=env, cwd=tmp_path, stdout=log, stderr=log)
    assert isinstance(process, subprocess.Popen)
    assert process.wait() == 0


def test_it_ends_with_tests_that_are_killed(tmp_path: Path) -> None:
    # Its imports take 12 CPU seconds, and this server forks once.
    bare = "from tests.support import fork_server as s; s._import = lambda: None; s.main()"
    script = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from tests.support import processes\n"
        "from tests.support.processes import PLACEWISE, start\n"
        "from tests.support.server import environment\n"
        "processes.FORK_SERVER = (sys.executable, '-c', sys.argv[2])\n"
        "cwd = Path(sys.argv[1])\n"
        "log = (cwd / 'log').open('wb')\n"
        "env = environment(cwd / 'home')\n"
        "process = start([PLACEWISE, 'serve'], env=env, cwd=cwd, stdout=log, stderr=log)\n"
        "print(process.pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path), bare],
        cwd=REPOSITORY,
        env={**os.environ, "PYTEST_XDIST_TESTRUNUID": str(tmp_path)},  # of another run
        stdout=subprocess.PIPE,
        text=True,
    ) as tests:
        assert tests.stdout is not None
        process = psutil.Process(int(tests.stdout.readline()))
        server = process.parent()
        assert server is not None
        assert tests.pid == server.ppid()
        tests.send_signal(signal.SIGKILL)
    wait_until(lambda: has_ended(process) and has_ended(server))
