"""`placewise serve`: the embedded Placewise, one process."""

from __future__ import annotations

import logging
import sys
from typing import Annotated

import typer

from services.cli.configuration import read_settings
from services.cli.output import explained, messages
from shared.admin_key import AdminKey, admin_key_file, is_loopback
from shared.settings import Settings


def serve(
    new_key: Annotated[
        bool,
        typer.Option(
            "--new-key", help="Make and print a new admin key; the old one is no longer good."
        ),
    ] = False,
) -> None:
    """Serve the embedded Placewise (HOST, PORT, PLACEWISE_HOME) until Ctrl-C.

    Where HOST is not loopback, every call needs the admin key, which the first start prints.
    """
    with explained(as_json=False):
        settings = read_settings()
        from services.standalone import standalone  # brings torch, as `connect` says

        set_log_levels(settings.debug)
        with standalone(settings, new_key=new_key) as running:
            messages.print(_welcome(running.url, running.key, settings), soft_wrap=True)
            running.serve()


def set_log_levels(debug: bool) -> None:
    """What Placewise itself says, in detail with DEBUG; of others, never each statement."""
    logging.getLogger().setLevel(logging.INFO)
    for ours in ("services", "shared"):
        logging.getLogger(ours).setLevel(logging.DEBUG if debug else logging.INFO)
    for others in ("alembic", "httpx2", "sqlalchemy"):
        logging.getLogger(others).setLevel(logging.WARNING)


def _welcome(url: str, key: AdminKey | None, settings: Settings) -> str:
    command = sys.argv[0]
    header = '-H "Authorization: Bearer $PLACEWISE_KEY" ' if key else ""
    lines = [
        f"Placewise serves {settings.placewise_home} on {url}",
        *_about_the_key(key, settings, command),
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


def _about_the_key(key: AdminKey | None, settings: Settings, command: str) -> list[str]:
    if key is None:
        return []
    lines = []
    if not is_loopback(settings.host):
        lines.append(f"  open to:  whoever reaches {settings.host} and has the key")
    if key.made is not None:
        lines.append(f"  key:      export PLACEWISE_KEY={key.made}")
        lines.append("            It is shown this once; every call needs it.")
    elif settings.admin_key is not None:
        lines.append("  key:      the one in ADMIN_KEY; every call needs it")
    else:
        lines.append("  key:      the one that was shown when it was made; every call needs it")
        lines.append(f"            Lost it? {command} serve --new-key makes another one;")
        lines.append(
            f"            so does a start without {admin_key_file(settings.placewise_home)}"
        )
    return lines
