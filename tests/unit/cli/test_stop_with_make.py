"""The server of `make run` ends with its shell, unless that has started it in the background."""

from __future__ import annotations

import subprocess
import sys
import time

from services.cli.operations.servers import _is_running

PRINT = "from services.cli.operations.servers import _is_in_background as f; print(f())"


def test_a_job_in_the_background_of_a_script_is_recognised() -> None:
    command = f'"{sys.executable}" -c "{PRINT}"'
    for suffix, expected in (("& wait", "True"), ("; true", "False")):
        shell = ["sh", "-c", f"{command} {suffix}"]
        shown = subprocess.run(
            shell, capture_output=True, text=True, check=True, start_new_session=True
        )
        assert shown.stdout.strip() == expected, suffix


def test_a_zombie_shell_is_not_running() -> None:
    with subprocess.Popen(["sh", "-c", "exec sleep 60"]) as shell:
        assert _is_running(shell.pid)
        shell.kill()
        deadline = time.monotonic() + 60
        while _is_running(shell.pid):
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert not _is_running(shell.pid)
