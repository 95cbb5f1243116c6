"""DEBUG in a checkout: the server restarts when its code changes, unless it does not compile."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from services.cli.operations.servers import ROOT, can_reload, restart_process, watch_code

WAIT_SECONDS = 20


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "module.py").write_text("VALUE = 1\n")
    return tmp_path


@pytest.fixture
def changed(folder: Path) -> Iterator[threading.Event]:
    event = threading.Event()
    stop = watch_code(event.set, [folder])
    yield event
    stop.set()


def test_a_checkout_can_be_reloaded_and_an_installed_package_cannot(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert (ROOT / "services" / "cli" / "operations" / "servers.py").exists()
    assert can_reload()
    monkeypatch.setattr("services.cli.operations.servers.ROOT", tmp_path)
    assert not can_reload()


def test_changed_code_is_noticed_once_it_compiles(
    folder: Path, changed: threading.Event, caplog: pytest.LogCaptureFixture
) -> None:
    def write_until(text: str, noticed: Callable[[], bool]) -> None:
        deadline = time.monotonic() + WAIT_SECONDS
        while not noticed():  # the watch may not have begun yet
            assert time.monotonic() < deadline, f"not noticed: {text!r}"
            (folder / "module.py").write_text(text)
            time.sleep(0.2)

    write_until("VALUE = (\n", lambda: "not restarted" in caplog.text)
    assert not changed.is_set()
    write_until("VALUE = 2\n", changed.is_set)


def test_a_restart_keeps_the_command_and_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    replaced = []
    monkeypatch.setattr(os, "execv", lambda path, arguments: replaced.append((path, arguments)))
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "dev", ".venv/bin/placewise", "serve"])
    restart_process()
    command = [sys.executable, "-X", "dev", ".venv/bin/placewise", "serve"]
    assert replaced == [(sys.executable, command)]
