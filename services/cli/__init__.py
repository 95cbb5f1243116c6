"""The `placewise` command: one module per group of commands, most of them clients of a server.

When no server is named or running on the folder, a command starts the embedded one for as long as
it needs it, so that there is one way of doing everything: over HTTP. `describe` alone keeps nothing
and needs none.
"""

import os


def main() -> None:
    """The console script."""
    # Read when torch is loaded: OpenMP's threads sleep while they wait for each other instead of
    # spinning. With spinning, a forward pass beside any other load took 50 times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Imported here: decoding child processes import the script anew, and must stay free of torch.
    from services.cli.main import run

    run()
