"""Commands that only call a server start without what only servers need."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version

from typer.testing import CliRunner

from services.cli.main import build_app

HEAVY = ("celery", "fastapi", "minio", "sqlalchemy", "starlette", "torch")


def test_the_help_of_the_program_imports_no_command_and_names_each_as_the_command_does() -> None:
    code = (
        "import sys\n"
        "from services.cli.main import run\n"
        "sys.argv = ['placewise', '--help']\n"
        "try:\n"
        "    run()\n"
        "finally:\n"
        "    print(*[name for name in sys.modules if name.startswith('services.cli.')])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    overview, imported = run.stdout.rstrip("\n").rsplit("\n", 1)
    assert imported == "services.cli.main services.cli.help_layout"
    complete = CliRunner().invoke(build_app(), ["--help"], prog_name="placewise")
    assert overview.split() == complete.output.split()


def test_no_command_imports_a_database_a_server_or_torch_before_it_runs() -> None:
    code = (
        "import sys\n"
        "from services.cli.main import build_app\n"
        "build_app()\n"
        f"print(*[name for name in {HEAVY!r} if name in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []


def test_the_collector_never_scans_what_a_command_has_imported() -> None:
    code = (
        "import gc, sys\n"
        "from services.cli.main import run\n"
        "sys.argv = ['placewise', 'maps', '--help']\n"
        "try:\n"
        "    run()\n"
        "finally:\n"
        "    print(gc.get_freeze_count() > 10_000, gc.isenabled())"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.endswith("True True\n")


def test_the_version_is_printed_without_importing_a_command() -> None:
    code = (
        "import sys\n"
        "from services.cli.main import run\n"
        "sys.argv = ['placewise', '--version']\n"
        "try:\n"
        "    run()\n"
        "except SystemExit as ended:\n"
        "    assert not ended.code\n"
        "assert 'services.cli.query' not in sys.modules\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == f"placewise {version('placewise')}\n"
