"""`placewise serve`: the embedded Placewise, one process."""

from __future__ import annotations

import ipaddress
import logging
import sys

from services.cli.configuration import read_settings
from services.cli.output import explained, messages
from shared.settings import Settings


def serve() -> None:
    """Serve the embedded Placewise (HOST, PORT, PLACEWISE_HOME) until Ctrl-C."""
    with explained(as_json=False):
        settings = read_settings()
        from services.standalone import standalone  # brings torch, as `connect` says

        logging.getLogger().setLevel(logging.INFO)
        logging.getLogger("alembic").setLevel(logging.WARNING)
        with standalone(settings) as running:
            messages.print(_welcome(running.url, settings), soft_wrap=True)
            running.serve()


def _welcome(url: str, settings: Settings) -> str:
    command = sys.argv[0]
    lines = [
        f"Placewise serves {settings.placewise_home} on {url}",
        f"  look:     {url}/docs   (the API)   {url}/api/v1/health",
        (
            f"  put in:   curl -F file=@PHOTO.jpg -F latitude=45.07 -F longitude=7.69 "
            f"{url}/api/v1/upload"
        ),
        f"  ask:      curl -F file=@OTHER.jpg -H 'Prefer: wait=30' {url}/api/v1/similarity",
        f"  a folder: {command} index DIR, then {command} query PHOTO",
    ]
    if not _is_loopback(settings.host):
        lines.append(
            "  careful:  there are no keys yet; whoever reaches this address can read and delete."
        )
    return "\n".join(lines)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
