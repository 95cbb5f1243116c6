"""`placewise serve`: the embedded Placewise, one process."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from services.cli.configuration import read_settings
from services.cli.output import explained, messages
from shared.api_keys import is_loopback
from shared.settings import Settings
from shared.telemetry.logs import set_up_logs
from shared.telemetry.traces import set_up_traces

if TYPE_CHECKING:
    from services.standalone import Standalone


def serve() -> None:
    """Serve the embedded Placewise (HOST, PORT, PLACEWISE_HOME) until Ctrl-C.

    Where HOST is not loopback, every call needs a key: the first start makes and prints an
    admin's, and `placewise keys` makes others.
    """
    with explained(as_json=False):
        settings = read_settings()
        from services.standalone import standalone  # brings torch, as `connect` says

        set_up_logs(settings, "embedded")
        with set_up_traces(settings, "embedded"), standalone(settings) as running:
            messages.print(_welcome(running, settings), soft_wrap=True)
            running.serve()


def _welcome(running: Standalone, settings: Settings) -> str:
    command, url = sys.argv[0], running.url
    header = '-H "Authorization: Bearer $PLACEWISE_KEY" ' if running.local_key else ""
    lines = [
        f"Placewise serves {settings.placewise_home} on {url}",
        *_about_the_key(running, settings, command),
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


def _about_the_key(running: Standalone, settings: Settings, command: str) -> list[str]:
    if running.local_key is None:
        return []
    lines = []
    if not is_loopback(settings.host):
        lines.append(f"  open to:  whoever reaches {settings.host} and has a key")
    if running.made_key is not None:
        lines.append(f"  key:      export PLACEWISE_KEY={running.made_key}")
        lines.append("            It is shown this once; every call needs one.")
    elif settings.admin_key is not None:
        lines.append("  key:      the one in ADMIN_KEY, or one of placewise keys list")
    else:
        lines.append("  key:      one that was shown when it was made: placewise keys list")
        lines.append(f"            Lost it? {command} keys create NAME --scope admin")
    return lines
