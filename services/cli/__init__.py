"""The `placewise` command: one module per group of commands, all of them clients of a server.

When no server is named or running on the folder, a command starts the embedded one for as long as
it needs it, so that there is one way of doing everything: over HTTP.
"""


def main() -> None:
    """The console script."""
    # Imported here: decoding child processes import the script anew, and must stay free of torch.
    from services.cli.main import run

    run()
