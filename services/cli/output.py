"""Command output: tables and progress bars, JSON, error reporting and atomic file writes.

Answers are written to stdout; progress and messages are written to stderr.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from operator import methodcaller
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import rich.table
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.segment import Segment
from rich.style import StyleType
from rich.table import Column
from rich.text import Text

from shared.errors import InvalidRequest, Misconfigured, PlacewiseError

_CONTROLS = (*range(0x20), *range(0x7F, 0xA0), 0x2028, 0x2029)
# Of the direction of text: photo<RIGHT-TO-LEFT OVERRIDE>gpj.exe would be shown as photoexe.jpg.
_DIRECTIONS = (0x061C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))
_REPLACED = dict.fromkeys((*_CONTROLS, *_DIRECTIONS), "\N{REPLACEMENT CHARACTER}")
_REPLACED_IN_LINES = {code: text for code, text in _REPLACED.items() if chr(code) not in "\n\t"}


def printable_text(text: str) -> str:
    """Return a name on one line: control characters, such as escape sequences, are replaced."""
    return text.translate(_REPLACED)


def first_names(names: Sequence[str], most: int = 3) -> str:
    """Join the first names for a message; dots stand for the others."""
    return ", ".join(names[:most]) + " ..." * (len(names) > most)


class _PrintableConsole(Console):
    """A console that replaces control characters in what it prints, but its own.

    Names of files and answers of servers may contain escape sequences, which a terminal obeys.
    """

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else text.translate(_REPLACED_IN_LINES), style, control)


# Progress and messages go to stderr, so that the answer on stdout can be piped.
err_console = _PrintableConsole(stderr=True, highlight=False)
console = _PrintableConsole(highlight=False)

Json = dict[str, Any]

AS_JSON = "as_json"
"""Key of the context's `meta`: whether the command prints JSON, for the report of its error."""


def _note_json(context: typer.Context, as_json: bool) -> bool:
    context.meta[AS_JSON] = as_json
    return as_json


JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON.", callback=_note_json)
]
MapOption = Annotated[
    str | None, typer.Option("--map", help="Name of the map. Default: `default`.")
]
TimeZoneOption = Annotated[
    str | None,
    typer.Option(
        metavar="ZONE",
        help="Time zone of photos whose EXIF has none, such as +02:00 or Europe/Paris.",
    ),
]


def utf8_path(path: Path) -> str:
    """Return the path as it is stored and sent; bytes that are not UTF-8 are replaced."""
    return os.fsencode(path).decode("utf-8", "replace")


def printable_path(path: Path) -> str:
    """Return the path as printable text on one line."""
    return printable_text(utf8_path(path))


def format_percent(share: float | None) -> str:
    """Return a share with one decimal, such as `55.3 %`; a dash for None."""
    return "-" if share is None else f"{100 * share:.1f} %"


def format_pca(pca: Json) -> str:
    """Return the sizes and the explained variance of a PCA whitening."""
    return (
        f"{pca['dimension']} of {pca['from_dimension']} dimensions with "
        f"{format_percent(pca['explained'])} of the variance of {pca['rows']} rows"
    )


def print_json(value: Any) -> None:
    """Print a value as JSON; answers of the server as the server sent them."""
    text = json.dumps(value, indent=2, ensure_ascii=False, default=methodcaller("as_json"))
    typer.echo(re.sub("[\x7f-\x9f]", lambda control: f"\\u{ord(control[0]):04x}", text))


def print_message(message: str) -> None:
    """Print a part of the answer to stdout, as it is: the terminal wraps it."""
    console.print(message, soft_wrap=True, markup=False)


def print_note(message: str) -> None:
    """As `print_message`, to stderr: about the command, not a part of its answer."""
    err_console.print(message, soft_wrap=True, markup=False)


class Table(rich.table.Table):
    """A table for `print_table`. In a narrow terminal, long texts and names continue below.

    A column without a header is left out of tab-separated output.
    """

    def __init__(
        self,
        *headers: Column | str,
        title: str | None = None,
        caption: str | None = None,
    ) -> None:
        super().__init__(
            *(Column(each, overflow="fold") if isinstance(each, str) else each for each in headers),
            title=title,
            caption=caption,
            box=SIMPLE_HEAD,
            show_edge=False,
            padding=(0, 1, 0, 0),
        )

    def add_row(
        self,
        *renderables: RenderableType | None,
        style: StyleType | None = None,
        end_section: bool = False,
    ) -> None:
        """Add a row; strings may contain markup."""
        # Before their width is measured.
        cells = (
            each.translate(_REPLACED_IN_LINES) if isinstance(each, str) else each
            for each in renderables
        )
        super().add_row(*cells, style=style, end_section=end_section)


def print_table(table: Table) -> None:
    """Print a table; unless stdout is a terminal, as tab-separated values."""
    if console.is_terminal:
        console.print(table)
        return
    if table.title:
        typer.echo(_plain_text(table.title))
    columns = (map(_plain_text, (c.header, *c.cells)) for c in table.columns if c.header)
    for row in zip(*columns, strict=True):
        typer.echo("\t".join(row))
    if table.caption:
        typer.echo(_plain_text(table.caption))


def print_result(result: Any, as_json: bool, shown: str | Table) -> None:
    """Print the result of a command as JSON, or else a message about it or a table of it."""
    if as_json:
        print_json(result)
    elif isinstance(shown, str):
        print_message(shown)
    else:
        print_table(shown)


def _plain_text(cell: RenderableType) -> str:
    text = Text.from_markup(cell) if isinstance(cell, str) else cell
    return printable_text(" ".join(text.plain.split())) if isinstance(text, Text) else ""


def report_error(error: Exception, as_json: bool) -> bool:
    """Print a PlacewiseError or database outage in one line; False for any other error."""
    problem = error if isinstance(error, PlacewiseError) else _database_problem(error)
    if problem is None:
        return False
    if as_json:
        print_json(problem.as_problem())
    else:
        # Escaped: file names may contain brackets, which rich would read as markup.
        err_console.print(f"[red]{problem.code}[/red]: {escape(problem.detail)}", soft_wrap=True)
    return True


def _database_problem(error: Exception) -> PlacewiseError | None:
    """The Unavailable error of a database failure; None for any other error."""
    if "sqlalchemy" not in sys.modules:
        return None
    from shared.catalog.database.errors import explain_outage  # few commands use a database

    return explain_outage(error)


LINE_SECONDS = 10.0  # between two lines of progress where stderr is not a terminal


class _ProgressLines(Progress):
    """Prints lines instead of bars."""

    _printed_at = 0.0

    def start(self) -> None:
        self._printed_at = time.monotonic()

    def update(self, task_id: TaskID, *args: Any, **changes: Any) -> None:
        super().update(task_id, *args, **changes)
        self._print(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._print(task_id)

    def _print(self, task_id: TaskID) -> None:
        if time.monotonic() - self._printed_at < LINE_SECONDS:
            return
        self._printed_at = time.monotonic()
        task = self._tasks[task_id]
        total = "" if task.total is None else f" of {task.total:,.0f}"
        line = f"{task.description}: {task.completed:,.0f}{total}, {task.elapsed or 0:.0f} s"
        self.console.print(line, soft_wrap=True)


def progress_bar() -> Progress:
    """A progress bar on stderr; if that is not a terminal, a line every LINE_SECONDS."""
    kind = Progress if err_console.is_terminal else _ProgressLines
    return kind(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=err_console,
        disable=not err_console.is_terminal,  # it would print an empty line at its end
    )


def stage_bars(progress: Progress, prefix: str = "") -> Callable[[str, int, int], None]:
    """Return a callback of (stage, done, total) that shows a bar per stage."""
    bars: dict[str, TaskID] = {}

    def report(stage: str, done: int, total: int) -> None:
        if stage not in bars:
            bars[stage] = progress.add_task(f"{prefix}{stage}", total=total)
        progress.update(bars[stage], completed=done, total=total)

    return report


def print_problem(mark: str, name: str, reason: str) -> None:
    """Print to stderr, with a mark such as `skipped`, what is wrong with a photo or a file."""
    line = f"{escape(printable_text(name))}: {escape(reason)}"
    err_console.print(f"[red]{mark}[/red] {line}", soft_wrap=True)


def print_failures(report: dict[str, Any], *outcomes: str) -> None:
    """Print the items of a report's lists `outcomes`: `path`, `reason`, `filename` if any."""
    for outcome in outcomes:
        if report[outcome]:
            err_console.print(f"{len(report[outcome])} {outcome}:")
        for item in report[outcome]:
            name = f" ({item['filename']})" if "filename" in item else ""
            print_problem(outcome, item["path"] + name, item["reason"])


@contextlib.contextmanager
def refuse_unwritable(out: Path) -> Iterator[None]:
    """Raise Misconfigured (`out_unwritable`) if the block fails to write to a file or folder."""
    try:
        yield
    except OSError as error:
        raise Misconfigured(
            "out_unwritable", f"Can't write to {printable_path(out)}: {error.strerror or error}."
        ) from error


@contextlib.contextmanager
def atomic_write(out: Path) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces `out` if the block succeeds and is removed otherwise.

    Raises:
        Misconfigured: `out_unwritable`.
    """
    partial = out.with_name(f".{out.name}.{os.getpid()}.partial")
    try:
        with refuse_unwritable(out):
            with partial.open("w+b") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            partial.replace(out)
    finally:
        # Fails if the folder itself is missing: then there is no file to remove.
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def check_output_path(out: Path, suffix: str, what: str) -> None:
    """Check an output path before the long computation of its content, `what` in the error.

    Raises:
        InvalidRequest: `bad_out` if the extension is wrong or the folder does not exist.
    """
    if out.suffix != suffix:
        raise InvalidRequest(
            "bad_out", f"{printable_path(out)}: the file name of {what} must end in {suffix}."
        )
    if not out.parent.is_dir():
        raise InvalidRequest(
            "bad_out", f"Folder {printable_path(out.parent)} does not exist. Create it first."
        )
