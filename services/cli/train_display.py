"""A training run on the terminal: bars while it works, tables when it is done."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any, Self

from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table

from services.cli.output import console, err_console

Json = dict[str, Any]

LOG_INTERVAL_SECONDS = 60.0
"""where stderr is no terminal, and bars would not be seen"""
SHOWN_KS = ("1", "5", "10", "20")


class TerminalDisplay:
    """Implements `services.trainer.display.Display` on stderr."""

    def __init__(self) -> None:
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=err_console,
            transient=True,
        )
        self._tasks: dict[str, TaskID] = {}
        self._line_at = time.monotonic() + LOG_INTERVAL_SECONDS

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bars.stop()

    def info(self, text: str) -> None:
        err_console.print(escape(text), soft_wrap=True)

    def warn(self, text: str) -> None:
        err_console.print(f"[yellow]{escape(text)}[/yellow]", soft_wrap=True)

    def progress(self, what: str, done: int, most: int, note: str = "") -> None:
        if not err_console.is_terminal:
            self._log_line(what, done, most, note)
            return
        task = self._tasks.get(what)
        if task is None:
            task = self._tasks[what] = self._bars.add_task(escape(what), total=most, note="")
        self._bars.update(task, completed=done, total=most, note=escape(note))
        if done >= most:
            self._bars.remove_task(self._tasks.pop(what))

    def _log_line(self, what: str, done: int, most: int, note: str) -> None:
        if time.monotonic() >= self._line_at:
            self._line_at = time.monotonic() + LOG_INTERVAL_SECONDS
            self.info(f"{what}: {done}/{most}  {note}".rstrip())


def print_summary(report: Json) -> None:
    """A run's summary: sets x R@k, the best checkpoint, what to type next."""
    if report.get("fast_dev_run"):
        return
    rows = _summary_rows(report)
    if rows:
        columns = (Column(f"R@{k}", justify="right") for k in SHOWN_KS)
        table = Table("set", "of", *columns, "queries", "fingerprint")
        for name, what, recall in rows:
            about = report["sets"][name]
            table.add_row(
                escape(name),
                what,
                *(f"{recall[k]:.1%}" if recall.get(k) is not None else "-" for k in SHOWN_KS),
                str(about["queries"]),
                f"{about['fingerprint'][:12]} {about['protocol']}, {about['rule']}",
            )
        console.print(table)
    best = report["best"]
    console.print(
        f"Checkpoint: {best['path']} ({best['dimension']} dimensions, {best['fingerprint'][:12]})",
        soft_wrap=True,
        markup=False,
    )
    if "images" in report and report["images_per_second"]:
        console.print(
            f"{report['images']} photos learned from, {report['images_per_second']:.1f}/s, "
            f"{report['share_waiting_for_data']:.1%} of the time waiting for photos; "
            f"{len(report['bad_photos'])} photos did not decode.",
            soft_wrap=True,
        )
    console.print("Next:", *(f"  {line}" for line in report["next"]), sep="\n", markup=False,
                  soft_wrap=True)  # fmt: skip


def _summary_rows(report: Json) -> list[tuple[str, str, Json]]:
    rows = []
    if report.get("epochs"):
        monitor = report["monitor"]
        chosen = max(
            report["epochs"],
            key=lambda each: (
                each["figures"].get(monitor, 0.0)
                * (1 if report["arguments"]["mode"] == "max" else -1)
            ),
        )
        for name in report["arguments"]["val_set_names"]:
            recall = {k: chosen["figures"].get(f"{name}/R{k}") for k in SHOWN_KS}
            rows.append((name, f"validation, epoch {chosen['number'] + 1}", recall))
    rows += [(name, "test", one["recall"]) for name, one in report["test"].items()]
    return rows
