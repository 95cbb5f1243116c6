"""Commands that run servers: `serve`, `gateway`, `extractor`, `search` and `steward`.

`serve` runs the embedded Placewise. The others run one service each; services share
DATABASE_URL (PostgreSQL), REDIS_URL, the object store and SEARCH_URLS. Each command imports its
service when it runs: importing takes a second or more, and each image has the packages of its
service only.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from services.cli import collection_paused
from services.cli.environment import read_settings
from services.cli.output import err_console, print_note
from shared.config.command_line import command_line
from shared.config.settings import Settings
from shared.security.api_keys import is_loopback

if TYPE_CHECKING:
    from services.standalone import Standalone


def serve() -> None:
    """Run the embedded Placewise (HOST, PORT, PLACEWISE_HOME) until Ctrl-C.

    If HOST is not a loopback address, every call requires an API key. The first start creates and
    prints an admin key; `placewise keys` creates others.
    """
    with collection_paused():
        from services.standalone import serve_standalone

    settings = read_settings()
    serve_standalone(settings, lambda running: print_note(_startup_message(running, settings)))


def _startup_message(running: Standalone, settings: Settings) -> str:
    """Return what `serve` prints; the address is at the end, where it stays visible."""
    # Complete: without its folder, a command of another shell would start a second Placewise.
    command = partial(command_line, home=settings.placewise_home)
    url = running.url
    header = '-H "Authorization: Bearer $PLACEWISE_KEY" ' if running.local_key else ""
    lines = [
        f"Placewise serves {settings.placewise_home} on {url}",
        *_key_instructions(running, settings, command),
        (
            f"  upload:   curl {header}-F file=@PHOTO.jpg -F latitude=45.07 -F longitude=7.69 "
            f"{url}/api/v1/upload"
        ),
        (
            f"  query:    curl {header}-F file=@OTHER.jpg -H 'Prefer: wait=30' "
            f"{url}/api/v1/similarity"
        ),
        f"  folder:   {command('index', 'DIR')}",
        f"            {command('query', 'PHOTO')}",
    ]
    if running.lan_url is not None:
        lines.append(f"  phone:    {running.lan_url}   (in the same network)")
        if err_console.is_terminal:
            lines.append(_qr_code(running.lan_url))
    lines.append(f"  API:      {url}/docs")
    lines.append(f"  open:     {url}")
    return "\n".join(lines)


def _qr_code(text: str) -> str:
    """Draw a QR code with half blocks, for a dark terminal; cameras also read the inverse."""
    import segno

    drawing = io.StringIO()
    segno.make_qr(text).terminal(out=drawing, border=2, compact=True)
    return drawing.getvalue()


def _key_instructions(
    running: Standalone, settings: Settings, command: Callable[..., str]
) -> list[str]:
    if running.local_key is None:
        return []
    lines = []
    if not is_loopback(settings.host):
        lines.append(f"  access:   anyone who can reach {settings.host} and has a key")
    if running.first_admin_key is not None:
        lines.append(f"  key:      export PLACEWISE_KEY={running.first_admin_key}")
        lines.append("            It is shown only once. Every call requires a key.")
    elif settings.admin_key is not None:
        lines.append(f"  key:      ADMIN_KEY, or one of those listed by {command('keys', 'list')}")
    else:
        create = command("keys", "create", "NAME", "--scope", "admin")
        lines.append(f"  key:      one of those listed by {command('keys', 'list')}")
        lines.append(f"            To create one: {create}")
    return lines


def search() -> None:
    """Run a search worker for all maps (HOST, PORT).

    The worker follows the catalog at DATABASE_URL. It requires no key: allow access only from the
    gateway and the steward, which find it through SEARCH_URLS.
    """
    with collection_paused():
        from services.search.service import serve_search

    serve_search(read_settings(), print_note)


def gateway() -> None:
    """Run the HTTP API (HOST, PORT).

    Every call requires an API key: ADMIN_KEY, or one created with `placewise keys`.
    """
    with collection_paused():
        from services.gateway.service import serve_gateway

    serve_gateway(read_settings(), print_note)


def extractor() -> None:
    """Run an extractor, which computes descriptors of photos.

    It is a Celery worker on REDIS_URL, DATABASE_URL and the object store.
    """
    with collection_paused():
        from services.extractor.service import serve_extractor

    serve_extractor(read_settings(), print_note)


def steward() -> None:
    """Run a steward: maintenance, evaluations, batch uploads and webhooks.

    Any number of stewards can run at the same time.
    """
    with collection_paused():
        from services.steward.service import serve_steward

    serve_steward(read_settings(), print_note)
