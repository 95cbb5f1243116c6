"""Commands that only call a server start without what only servers need."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ("celery", "fastapi", "minio", "sqlalchemy", "starlette", "torch")
CLIENT_COMMANDS = (
    "export",
    "import-anyloc",
    "index",
    "keys",
    "maps",
    "models",
    "pca",
    "query",
    "track",
    "vocabulary",
)


def test_commands_that_call_a_server_import_neither_a_database_nor_a_server_nor_torch() -> None:
    code = (
        "import sys\n"
        "from services.cli.main import build_app\n"
        f"build_app({CLIENT_COMMANDS!r})\n"
        f"print(*[name for name in {HEAVY!r} if name in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []
