"""The `placewise` command-line interface: one module per command group.

Most commands are HTTP clients. A command connects to the server given by `--server`, or to the one
that runs on PLACEWISE_HOME, and otherwise starts an embedded server for its own duration, so that
every operation takes the same path. Commands that work on files alone (`describe`, `compare`,
`datasets`, `train`) need no server.
"""

import contextlib
import gc
import os
import sys
from collections.abc import Iterator


def main() -> None:
    """Run the `placewise` console script."""
    # OpenMP reads this when torch is loaded. PASSIVE makes its threads sleep at barriers instead of
    # spinning: with spinning, a forward pass took 50 times as long on a machine under other load.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # A start allocates a million objects that stay: collecting garbage every 700 of them takes a
    # fifth of the time that importing takes.
    gc.set_threshold(50_000, 20, 20)
    try:
        # Imported here: decoding child processes re-import this script and must not load torch.
        from services.cli.main import run

        run()
    except KeyboardInterrupt:  # while commands are imported; later ones are reported by Typer
        sys.exit(130)


@contextlib.contextmanager
def collection_paused() -> Iterator[None]:
    """Context manager for imports, in which the garbage collector is paused.

    Modules create a quarter of a million objects, none of them garbage. The collector would scan
    them several times during the imports, and again at each full collection afterwards.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
