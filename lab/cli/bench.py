"""`placewise bench`: the benchmarks of `lab/benchmarks`, which run in a checkout only.

Each is a module with a function `bench`, its command. One that misses its target exits with code 1.
"""

from __future__ import annotations

import importlib
from typing import Any

import typer
from typer.core import TyperGroup

from services.cli.environment import require_packages

BENCHMARKS = (
    "search",
    "pipeline",
    "estimates",
    "matches",
    "extract",
    "pose",
)


class _BenchmarkGroup(TyperGroup):
    """Imports the module of the benchmark that is run: some of them load torch."""

    def list_commands(self, _ctx: Any) -> list[str]:
        return list(BENCHMARKS)

    def get_command(self, _ctx: Any, name: str) -> Any:
        if name not in BENCHMARKS:
            return None
        require_packages("tests", "faiss", "psutil", "pytest", "testcontainers")
        module = importlib.import_module(f"lab.benchmarks.{name.replace('-', '_')}")
        benchmark = typer.Typer(add_completion=False, rich_markup_mode=None)
        benchmark.command(name)(module.bench)
        return typer.main.get_command(benchmark)


app = typer.Typer(help="Run benchmarks on this machine.", cls=_BenchmarkGroup, no_args_is_help=True)


@app.callback()
def _callback() -> None:
    """Make a group of an application that declares no command itself."""
