"""Files that are there when they are whole."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from services.cli.output import printable_path
from shared.errors import InvalidRequest, Misconfigured


@contextlib.contextmanager
def atomic_write(out: Path) -> Iterator[BinaryIO]:
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
            "out_unwritable", f"{printable_path(out)} can't be written: {error.strerror}."
        ) from error
    finally:
        # Where even the folder is missing, there is nothing to take away.
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def check_output_path(out: Path, suffix: str, what: str) -> None:
    """InvalidRequest (`bad_out`) unless `out` ends in `suffix` and its folder is there.

    Asked before the minutes that it takes to make `what` ("a vocabulary", say).
    """
    if out.suffix != suffix:
        raise InvalidRequest("bad_out", f"{printable_path(out)}: {what}'s file ends in {suffix}.")
    if not out.parent.is_dir():
        raise InvalidRequest("bad_out", f"There is no folder {printable_path(out.parent)}.")
