"""Commands that are shown to a user, complete enough to be pasted into any shell."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path


def command_line(*arguments: str | Path, home: Path | None = None) -> str:
    """Return a command of the running program that works in any folder.

    Args:
        arguments: The subcommand and its arguments; paths are made absolute.
        home: PLACEWISE_HOME, for a command that uses it: its default depends on the folder.

    Returns:
        Printable text; bytes of a path that are not UTF-8 are replaced.
    """
    words = [str(each.absolute()) if isinstance(each, Path) else each for each in arguments]
    command = shlex.join([str(Path(sys.argv[0]).absolute()), *words])
    if home is not None:
        command = f"PLACEWISE_HOME={shlex.quote(str(home.absolute()))} {command}"
    return os.fsencode(command).decode("utf-8", "replace")
