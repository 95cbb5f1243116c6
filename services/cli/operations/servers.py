"""Commands that run servers: `serve`, `gateway`, `extractor`, `search` and `steward`.

`serve` runs the embedded Placewise in one process. The others run one service each; services share
DATABASE_URL (PostgreSQL), REDIS_URL, the object store and SEARCH_URLS. Each command imports its
service when it runs: importing takes a second or more, and each image has the packages of its
service only.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from services.cli import collection_paused
from services.cli.environment import read_settings
from services.cli.output import err_console, print_note
from shared.config.command_line import command_line
from shared.config.settings import Settings
from shared.security.api_keys import is_loopback

if TYPE_CHECKING:
    from services.standalone import Standalone


log = logging.getLogger(__name__)

ROOT = Path(__file__).parents[3]
PARENT_POLL_SECONDS = 1.0
CODE_FOLDERS = tuple(ROOT / package for package in ("placewise", "services", "shared"))


def serve() -> None:
    """Run the embedded Placewise (HOST, PORT, PLACEWISE_HOME) until Ctrl-C.

    If HOST is not a loopback address, every call requires an API key. The first start creates and
    prints an admin key; `placewise keys` creates others. With DEBUG, in a checkout of the
    repository, the server restarts when its code changes.
    """
    with collection_paused():
        from services.standalone import serve_standalone

    changed = threading.Event()
    settings = read_settings()

    def announce(running: Standalone) -> None:
        print_note(_startup_message(running, settings))

        def stop() -> None:
            running.server.should_exit = True

        if "MAKELEVEL" in os.environ:
            stop_with_make(stop)
        if settings.debug and can_reload():

            def restart() -> None:
                changed.set()
                stop()

            watch_code(restart)

    serve_standalone(settings, announce)
    if changed.is_set():
        restart_process()


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


def stop_with_make(stop: Callable[[], object]) -> None:
    """Call `stop` once the `make` that runs this process, or the shell that runs `make`, has ended.

    A closed terminal sends SIGHUP to all of them. A killed shell sends nothing, and its server
    would keep the port and PLACEWISE_HOME. `nohup make run` ignores SIGHUP: it outlives its shell,
    and so does `make run &`.
    """
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        return
    make = shell = os.getppid()
    ps = None if _is_in_background() else shutil.which("ps")
    if ps is not None:
        command = [ps, "-o", "ppid=", "-p", str(make)]
        # Without an answer, for example of a process that is hidden, only make is watched.
        with contextlib.suppress(OSError, subprocess.SubprocessError, ValueError):
            shell = int(subprocess.check_output(command))  # noqa: S603  (our own command)

    def run() -> None:
        while os.getppid() == make and _is_running(shell):
            time.sleep(PARENT_POLL_SECONDS)
        stop()

    threading.Thread(target=run, name="parent watch", daemon=True).start()


def _is_in_background() -> bool:
    """Return whether a shell has started this process in the background.

    A shell without job control lets such processes ignore SIGINT; another one gives them a process
    group that is not the terminal's.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        return True
    try:
        with Path("/dev/tty").open() as terminal:
            return os.tcgetpgrp(terminal.fileno()) != os.getpgrp()
    except OSError:  # no terminal
        return False


def _is_running(process_id: int) -> bool:
    try:
        os.kill(process_id, 0)
        # Linux: one that has ended stays there, as a zombie, until its parent reads its status.
        return Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except ProcessLookupError:
        return False
    except OSError:  # of another user, or a system without /proc
        return True


def can_reload() -> bool:
    """Whether the code runs from a checkout with the extra dev, which has watchfiles."""
    return (ROOT / "pyproject.toml").exists() and find_spec("watchfiles") is not None


def watch_code(
    on_change: Callable[[], object], folders: Iterable[Path] = CODE_FOLDERS
) -> threading.Event:
    """Call `on_change` once, in a thread of its own, when a Python file below the folders changes.

    A file that does not compile is logged instead: the running server continues until it does.

    Returns:
        An event that ends the watch when it is set.
    """
    from watchfiles import PythonFilter, watch

    stop = threading.Event()

    def run() -> None:
        for changes in watch(*folders, watch_filter=PythonFilter(), stop_event=stop):
            paths = sorted({Path(path) for _, path in changes})
            if all(_compiles(path) for path in paths if path.exists()):
                log.info("%s changed: restarting", ", ".join(path.name for path in paths))
                on_change()
                return

    threading.Thread(target=run, name="code reload", daemon=True).start()
    return stop


def _compiles(path: Path) -> bool:
    try:
        compile(path.read_bytes(), path, "exec")
    except SyntaxError as error:
        log.warning("%s:%s: %s; not restarted", path, error.lineno, error.msg)
        return False
    return True


def restart_process() -> None:
    """Replace this process by a new one with the same command, environment and id."""
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606  (our own command)


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
