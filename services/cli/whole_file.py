"""Files that are there when they are whole."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from services.cli.output import shown
from shared.errors import Misconfigured


@contextlib.contextmanager
def whole_or_nothing(out: Path) -> Iterator[BinaryIO]:
    """A file that takes its name when the block has ended well; else nothing is left of it.

    Raises Misconfigured (`out_unwritable`).
    """
    partial = out.with_name(f".{out.name}.{os.getpid()}.partial")
    try:
        with partial.open("w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(out)
    except OSError as error:
        raise Misconfigured(
            "out_unwritable", f"{shown(out)} can't be written: {error.strerror}."
        ) from error
    finally:
        # Where even the folder is missing, there is nothing to take away.
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
