"""What a command prints: tables and progress for people, JSON for programs, errors for both.

Files that are there when they are whole.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from shared.errors import InvalidRequest, Misconfigured, PlacewiseError

# Progress and messages go to stderr: stdout is the answer, and can be piped.
err_console = Console(stderr=True, highlight=False)
console = Console(highlight=False)

JsonOption = Annotated[bool, typer.Option("--json", help="Print the answer as JSON.")]
MapOption = Annotated[str | None, typer.Option("--map", help="The map that is meant.")]
ServerOption = Annotated[
    str | None,
    typer.Option(
        "--server",
        envvar="PLACEWISE_SERVER",
        help="Address of a running Placewise; left out: the one on PLACEWISE_HOME.",
    ),
]

KeyOption = Annotated[
    str | None,
    typer.Option(
        "--key",
        envvar="PLACEWISE_KEY",
        help="The key that the server wants. Better in the variable: others on this machine can "
        "see a command's options. Not needed for the server on PLACEWISE_HOME.",
    ),
]


def printable_path(path: Path) -> str:
    """The path as text that can be printed, also where it is not UTF-8."""
    return os.fsencode(path).decode("utf-8", "replace")


def print_json(value: Any) -> None:
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False))


@contextlib.contextmanager
def report_errors(as_json: bool) -> Iterator[None]:
    """Turn an error that can be explained into one line and exit code 1."""
    try:
        yield
    except PlacewiseError as error:
        _print_error(error, as_json)
        raise typer.Exit(1) from error
    except Exception as error:
        unavailable = _database_problem(error)
        if unavailable is None:
            raise
        _print_error(unavailable, as_json)
        raise typer.Exit(1) from error


def _database_problem(error: Exception) -> PlacewiseError | None:
    """The explanation of a failure of the catalog; None for every other error."""
    if "sqlalchemy" not in sys.modules:
        return None
    from shared.catalog.database_errors import to_unavailable  # most commands do without a database

    return to_unavailable(error)


def _print_error(error: PlacewiseError, as_json: bool) -> None:
    if as_json:
        print_json(error.as_problem())
    else:
        # What went wrong is no markup: a file's name may hold brackets.
        err_console.print(f"[red]{error.code}[/red]: {escape(error.detail)}", soft_wrap=True)


def progress_bar() -> Progress:
    """A bar on stderr; silent where stderr is no terminal."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=err_console,
    )


def print_failures(report: dict[str, Any], *words: str) -> None:
    """What is listed under each of the words, with its reason."""
    for word in words:
        if report[word]:
            err_console.print(f"{len(report[word])} {word}:")
        for item in report[word]:
            name = f" ({item['filename']})" if "filename" in item else ""
            err_console.print(
                f"[red]{word}[/red] {escape(item['path'] + name)}: {escape(item['reason'])}",
                soft_wrap=True,
            )


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
