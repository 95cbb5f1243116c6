"""`placewise doctor`: check an installation part by part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import typer
from rich.markup import escape

from services.cli.environment import read_settings
from services.cli.output import JsonOption, KeyOption, ServerOption, console, print_json
from shared.config.settings import Settings
from shared.errors import Misconfigured, PlacewiseError


@dataclass(frozen=True, slots=True)
class _CheckResult:
    """Outcome of one check."""

    part: str
    ok: bool
    detail: str


def doctor(server: ServerOption = None, key: KeyOption = None, as_json: JsonOption = False) -> None:
    """Check this installation. The exit code is 1 if a part needs attention.

    With DATABASE_URL, the services of a deployment are checked: run the command where a service
    runs, with that service's settings. --server is the gateway's URL.
    """
    try:
        settings = read_settings()
    except Misconfigured as error:
        _print_results([_CheckResult("settings", False, error.detail)], as_json)
        raise typer.Exit(1) from None
    # Imported here: the help does not need a database.
    from services.cli.operations.installation_checks import list_checks

    results = [
        _run_check(part, check, settings) for part, check in list_checks(settings, server, key)
    ]
    _print_results(results, as_json)
    if not all(result.ok for result in results):
        raise typer.Exit(1)


def _print_results(results: list[_CheckResult], as_json: bool) -> None:
    if as_json:
        print_json([asdict(result) for result in results])
        return
    for result in results:
        mark = "[green]ok[/green]  " if result.ok else "[red]look[/red]"
        # Escaped: paths may contain brackets, which rich would read as markup.
        console.print(f"{mark} {result.part}: {escape(result.detail)}", soft_wrap=True)


def _run_check(part: str, check: Callable[[Settings], str], settings: Settings) -> _CheckResult:
    try:
        return _CheckResult(part, True, check(settings))
    except PlacewiseError as error:
        return _CheckResult(part, False, error.detail)
    except ModuleNotFoundError as error:
        # An image contains only the packages of its service.
        return _CheckResult(part, True, f"skipped: {error.name} is not installed here")
    except OSError as error:
        return _CheckResult(
            part, False, f"{error.filename or ''}: {error.strerror}. Check permissions."
        )
