"""`placewise serve`: the embedded Placewise, one process."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from services.cli.configuration import read_settings
from services.cli.output import err_console, report_errors
from shared.api_keys import is_loopback
from shared.settings import Settings
from shared.telemetry.logs import configure_logging
from shared.telemetry.traces import configure_tracing

if TYPE_CHECKING:
    from services.standalone import Standalone


def serve() -> None:
    """Serve the embedded Placewise (HOST, PORT, PLACEWISE_HOME) until Ctrl-C.

    Where HOST is not loopback, every call needs a key: the first start makes and prints an
    admin's, and `placewise keys` makes others.
    """
    with report_errors(as_json=False):
        settings = read_settings()
        from services.standalone import run_standalone  # brings torch, as `connect` says

        configure_logging(settings, "embedded")
        with configure_tracing(settings, "embedded"), run_standalone(settings) as running:
            err_console.print(_startup_message(running, settings), soft_wrap=True)
            running.serve()


def _startup_message(running: Standalone, settings: Settings) -> str:
    command, url = sys.argv[0], running.url
    header = '-H "Authorization: Bearer $PLACEWISE_KEY" ' if running.local_key else ""
    lines = [
        f"Placewise serves {settings.placewise_home} on {url}",
        *_key_instructions(running, settings, command),
        f"  look:     {url}   (the page)   {url}/docs   (the API)",
        (
            f"  put in:   curl {header}-F file=@PHOTO.jpg -F latitude=45.07 -F longitude=7.69 "
            f"{url}/api/v1/upload"
        ),
        (
            f"  ask:      curl {header}-F file=@OTHER.jpg -H 'Prefer: wait=30' "
            f"{url}/api/v1/similarity"
        ),
        f"  a folder: {command} index DIR, then {command} query PHOTO",
    ]
    return "\n".join(lines)


def _key_instructions(running: Standalone, settings: Settings, command: str) -> list[str]:
    if running.local_key is None:
        return []
    lines = []
    if not is_loopback(settings.host):
        lines.append(f"  open to:  whoever reaches {settings.host} and has a key")
    if running.first_admin_key is not None:
        lines.append(f"  key:      export PLACEWISE_KEY={running.first_admin_key}")
        lines.append("            It is shown this once; every call needs one.")
    elif settings.admin_key is not None:
        lines.append("  key:      the one in ADMIN_KEY, or one of placewise keys list")
    else:
        lines.append("  key:      one that was shown when it was made: placewise keys list")
        lines.append(f"            Lost it? {command} keys create NAME --scope admin")
    return lines
