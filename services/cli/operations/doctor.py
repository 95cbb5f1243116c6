"""`placewise doctor`: check an installation, and print the health of its server."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import httpx2
import typer
from rich.markup import escape

from placewise.protocol import may_use_proxy, response_error
from services.cli.client import ServerOptions
from services.cli.environment import read_settings
from services.cli.output import console, print_json
from shared.config.command_line import command_line
from shared.config.embedded_home import RunningServer, find_running_server
from shared.config.settings import Settings
from shared.errors import Misconfigured, PlacewiseError

HEALTH_TIMEOUT_SECONDS = 10.0


@dataclass(frozen=True, slots=True)
class _CheckResult:
    """Outcome of one check."""

    part: str
    ok: bool
    detail: str


def doctor(common: ServerOptions) -> None:
    """Check this installation, and print the health of a running server.

    The exit code is 1 if a part needs attention. Run the command where a service runs, with that
    service's settings. With DATABASE_URL, --server is the gateway's URL.
    """
    try:
        settings = read_settings()
    except Misconfigured as error:
        _print_results([_CheckResult("settings", False, error.detail)], common.as_json)
        raise typer.Exit(1) from None
    # Imported here: the help does not need a database.
    from services.cli.operations.installation_checks import list_checks

    home = settings.placewise_home
    running = RunningServer(common.server) if common.server else find_running_server(home)
    results = [
        _run_check(part, check, settings)
        for part, check in list_checks(settings, has_server=running is not None)
    ]
    if running is not None:
        results += _read_health(running.url, common.key or running.key)
    elif settings.database_url is not None:
        results.append(_CheckResult("server", True, "not checked: name the gateway, --server URL"))
    else:
        start = command_line("serve", home=home)
        results.append(_CheckResult("server", True, f"not running. Start it: {start}"))
    _print_results(results, common.as_json)
    if not all(result.ok for result in results):
        raise typer.Exit(1)


def _read_health(url: str, key: str | None) -> list[_CheckResult]:
    """Return the server's version and load, and each part of its GET /health, also of a 503."""
    try:
        response = httpx2.get(
            f"{url.rstrip('/')}/api/v1/health",
            headers={"Authorization": f"Bearer {key}"} if key else {},
            timeout=HEALTH_TIMEOUT_SECONDS,
            trust_env=may_use_proxy(url),
        )
    except httpx2.HTTPError as error:
        detail = f"{url} does not answer ({type(error).__name__}). Check the URL."
        return [_CheckResult("server", False, detail)]
    try:
        body: dict[str, Any] = response.json()
        reported: dict[str, dict[str, Any]] = body["parts"]
    except (ValueError, KeyError, TypeError):
        detail = response_error(response).detail
        return [_CheckResult("server", False, f"{url} answers: {detail}")]
    summary = f"{url} runs {body['version']}"
    if load := body["load"]:
        summary += (
            f": {load['waiting_jobs']} jobs queued, {load['finished_per_second']:.1f} photos/s"
        )
    parts = [
        _CheckResult(
            f"server {name.replace('_', ' ')}",
            part["status"] == "healthy",
            f"{part['status']}: {part['detail']}" if part["detail"] else part["status"],
        )
        for name, part in reported.items()
    ]
    return [_CheckResult("server", True, summary), *parts]


def _print_results(results: list[_CheckResult], as_json: bool) -> None:
    if as_json:
        print_json([asdict(result) for result in results])
        return
    for result in results:
        mark = "[green]ok[/green]  " if result.ok else "[red]look[/red]"
        # Escaped: paths may contain brackets, which rich would read as markup.
        console.print(f"{mark} {escape(f'{result.part}: {result.detail}')}", soft_wrap=True)


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
