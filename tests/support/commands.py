"""Commands of `placewise` in this process."""

from __future__ import annotations

import json
from typing import Any

from typer.testing import CliRunner, Result

from services.cli.main import build_app


def run(*arguments: object, code: int | None = 0) -> Result:
    """`placewise ARGUMENTS`, which ends with the exit code; None is any, as of a missed aim."""
    command, *words = map(str, arguments)
    result = CliRunner().invoke(build_app([command]), [command, *words])
    assert code in (None, result.exit_code), result.output
    return result


def run_json(*arguments: object, code: int = 0) -> Any:
    """What `placewise ARGUMENTS --json` prints."""
    return json.loads(run(*arguments, "--json", code=code).stdout)
