"""Every command in the README is run, in its order, as a newcomer would."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx2
import pytest

from tests.support.photos import near_copy, photo_bytes
from tests.support.processes import forked_program
from tests.support.waiting import wait_until

REPOSITORY = Path(__file__).parents[2]
README = REPOSITORY / "README.md"
ADDRESS = "127.0.0.1:8000"
SUCCEEDED = '"state":"succeeded"'
# Drawing and indexing a city takes minutes; a hamlet shows as much.
LONG = {"--places 300": "--places 8 --views 2 --size 96x72"}
STARTED_BY_HAND = ("make run", "make test")
UUID = r"[0-9a-f]{8}-[0-9a-f]{4}-7[0-9a-f]{3}-[0-9a-f]{4}-[0-9a-f]{12}"


@dataclass(frozen=True, slots=True)
class Command:
    text: str
    shown: str
    """The output that the README shows below it."""


def commands() -> list[Command]:
    found = []
    for block in re.findall(r"```console\n(.*?)```", README.read_text(), re.DOTALL):
        for part in block.split("$ ")[1:]:
            text, _, shown = part.partition("\n")
            found.append(Command(text, shown))
    return found


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the photos that the README speaks of, beside a `.venv`.

    Its `placewise` is a fork: twelve new interpreters would import the same.
    """
    folder = tmp_path_factory.mktemp("newcomer")
    programs = folder / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name in ("lib", "pyvenv.cfg", "bin/python"):
        (folder / ".venv" / name).symlink_to(REPOSITORY / ".venv" / name)
    forked_program(programs / "placewise")
    (folder / "street.jpg").write_bytes(photo_bytes(1))
    (folder / "again.jpg").write_bytes(near_copy(1))
    (folder / "photos").mkdir()
    for number in range(2, 6):
        (folder / "photos" / f"{number}.jpg").write_bytes(photo_bytes(number))
    return folder


@pytest.fixture(scope="module")
def port(place: Path) -> Iterator[int]:
    """The free port of a server that `make run` has started from the repository."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        free: int = probe.getsockname()[1]
    with (place / "run.log").open("wb") as log:
        process = subprocess.Popen(
            ["make", "run", f"PORT={free}"],
            cwd=REPOSITORY,
            env=_environment(place),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )

    def shows_its_address() -> bool:
        shown = (place / "run.log").read_text()
        assert process.poll() is None, shown
        return bool(re.search(r"^  open: .+\n", shown, re.MULTILINE))

    try:
        wait_until(shows_its_address)
        yield free
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=60)


def _run(text: str, place: Path) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", text],
        cwd=place,
        env=_environment(place),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
    return done


def test_every_command_of_the_readme_does_what_the_readme_shows(place: Path, port: int) -> None:
    ids: dict[str, str] = {}
    ran = 0
    for command in commands():
        if command.text in STARTED_BY_HAND:
            continue
        text = command.text.replace(ADDRESS, f"127.0.0.1:{port}")
        for shown, real in {**ids, **LONG}.items():
            text = text.replace(shown, real)
        done = _run(text, place)
        while SUCCEEDED in command.shown and SUCCEEDED not in done.stdout:  # a slow machine
            done = _run(text, place)
        ids |= dict(
            zip(re.findall(UUID, command.shown), re.findall(UUID, done.stdout), strict=False)
        )
        assert_shows_the_same(command, done.stdout)
        if "vocabularies" in text:
            job = json.loads(done.stdout)["status_url"]
            httpx2.get(f"http://127.0.0.1:{port}{job}", params={"wait": 60}, timeout=90)
        ran += 1
    assert ran >= 14


def test_the_readmes_python_prints_an_estimate(place: Path, port: int) -> None:
    [block] = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    (place / "example.py").write_text(block.replace(ADDRESS, f"127.0.0.1:{port}"))
    done = _run(".venv/bin/python example.py", place)
    assert "in_map=" in done.stdout
    assert "latitude=" in done.stdout


def test_make_run_shows_the_address_last(place: Path, port: int) -> None:
    shown = (place / "run.log").read_text()
    [block] = re.findall(r"^Placewise serves .+\n(?:  .+\n)+", shown, re.M)
    assert block.endswith(f" http://127.0.0.1:{port}\n")


def test_make_alone_lists_its_targets_and_knows_each() -> None:
    done = subprocess.run(["make"], cwd=REPOSITORY, check=True, capture_output=True, text=True)
    targets = re.findall(r"^ *make ([a-z-]+) ", done.stdout, re.MULTILINE)
    expected = {"setup", "run", "test", "lint", "types", "bench", "env", "clean"}
    assert set(targets) >= expected
    subprocess.run(["make", "-n", *targets], cwd=REPOSITORY, check=True, capture_output=True)


def assert_shows_the_same(command: Command, real: str) -> None:
    """Every JSON member that the README shows is in the real output, in any order."""
    for member in re.findall(r'"([a-z_]+)":', command.shown):
        assert f'"{member}"' in real, f"{command.text}: no {member} in {real}"


def _environment(place: Path) -> dict[str, str]:
    """The README's settings: the default extractor, with the data in the newcomer's folder."""
    retained = {
        k: v for k, v in os.environ.items() if k not in ("EXTRACTOR", "ALLOW_TEST_EXTRACTORS")
    }
    return {**retained, "PLACEWISE_HOME": str(place / "var"), "HOST": "127.0.0.1"}
