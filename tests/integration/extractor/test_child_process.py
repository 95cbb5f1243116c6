"""A function in a child process: its result, its errors, and its end with that of its parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from services.extractor.child_process import NICENESS, ChildKilled, run_in_child
from shared.errors import Unprocessable
from shared.jobs.runner import JobInterrupted
from tests.support.waiting import wait_until

ROOT = Path(__file__).parents[3]
Report = Callable[..., None]


def count_to(most: int, report: Report) -> int:
    for number in range(most):
        report("counting", number)
    return os.nice(0)


def refuse(report: Report) -> None:
    raise Unprocessable("no_photos", "There is nothing to fit on.")


def divide(report: Report) -> float:
    return 1 / 0


def kill_itself(report: Report) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def sleep(report: Report) -> None:
    report(os.getpid())
    time.sleep(600)


def nothing(*_: Any) -> None:
    pass


def test_progress_and_result_arrive_from_a_process_of_low_priority() -> None:
    seen: list[tuple[str, int]] = []

    def note(stage: str, number: int) -> None:
        seen.append((stage, number))

    niceness = run_in_child(count_to, 3, on_progress=note, check=nothing)
    assert seen == [("counting", 0), ("counting", 1), ("counting", 2)]
    assert niceness == min(19, os.nice(0) + NICENESS)


def test_an_error_arrives_as_it_was_raised_with_the_traceback_as_a_note() -> None:
    with pytest.raises(Unprocessable, match="nothing to fit on") as refused:
        run_in_child(refuse, on_progress=nothing, check=nothing)
    assert refused.value.code == "no_photos"
    with pytest.raises(ZeroDivisionError) as raised:
        run_in_child(divide, on_progress=nothing, check=nothing)
    assert "return 1 / 0" in "\n".join(raised.value.__notes__)


def test_a_process_that_dies_is_an_error_that_says_how() -> None:
    with pytest.raises(ChildKilled, match=r"code -9; .* memory"):
        run_in_child(kill_itself, on_progress=nothing, check=nothing)


def test_cancelling_ends_the_child_process_at_once() -> None:
    pids: list[int] = []

    def check() -> None:
        if pids:
            raise JobInterrupted

    started = time.monotonic()
    with pytest.raises(JobInterrupted):
        run_in_child(sleep, on_progress=pids.append, check=check)
    assert time.monotonic() - started < 60
    assert not psutil.pid_exists(pids[0])


PARENT = """
from services.extractor.child_process import run_in_child
from tests.integration.extractor.test_child_process import sleep
if __name__ == "__main__":
    run_in_child(sleep, on_progress=lambda pid: print(pid, flush=True), check=lambda: None)
"""


def test_a_child_process_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, text=True, env=environment
    ) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        parent.kill()
    wait_until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE, 60)
