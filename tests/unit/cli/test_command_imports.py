"""Commands that only call a server start without what only servers need."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version

from typer.testing import CliRunner

from services.cli.main import build_app

HEAVY = ("celery", "fastapi", "minio", "sqlalchemy", "starlette", "torch")


def printed_by(code: str) -> str:
    """What a new interpreter prints that executes this."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def printed_after(*arguments: str, code: str) -> str:
    """What `placewise ARGUMENTS` prints, and then this code in its process."""
    return printed_by(
        "import gc, sys\n"
        "from services.cli.main import run\n"
        f"sys.argv = ['placewise', *{arguments!r}]\n"
        "try:\n"
        "    run()\n"
        "finally:\n"
        f"    {code}"
    )


def test_the_help_of_the_program_imports_no_command_and_names_each_as_the_command_does() -> None:
    own = "print(*[name for name in sys.modules if name.startswith('services.cli.')])"
    overview, imported = printed_after("--help", code=own).rstrip("\n").rsplit("\n", 1)
    assert imported == "services.cli.main"
    complete = CliRunner().invoke(build_app(), ["--help"], prog_name="placewise")
    assert overview.split() == complete.output.split()


def test_no_command_but_storage_imports_a_database_a_server_or_torch_before_it_runs() -> None:
    imported = printed_by(
        "import sys\n"
        "from services.cli.main import COMMANDS, build_app\n"
        "build_app(COMMANDS.keys() - {'storage'})\n"
        f"print(*[name for name in {HEAVY!r} if name in sys.modules])"
    )
    assert imported.split() == []


def test_the_version_is_printed_without_importing_a_command() -> None:
    printed = printed_after("--version", code="print('services.cli.query' in sys.modules)")
    assert printed == f"placewise {version('placewise')}\nFalse\n"
