"""`placewise bench`: the benchmarks of `lab/benchmarks`, which run in a checkout only.

Each benchmark is a module with a function `bench`, which is its command. They start their own
PostgreSQL, Redis and S3 servers. One that misses its target exits with code 1.
"""

from __future__ import annotations

import importlib
from typing import Any

import typer
from typer.core import TyperGroup

from shared.errors import Misconfigured

MODULES = {
    "search": "search",
    "pipeline": "pipeline",
    "query-latency": "query_latency",
    "chaos": "chaos.run",
    "estimates": "estimates",
    "extract": "extract",
    "train": "train",
}
DEV_PACKAGES = ("lab", "tests", "faiss", "psutil", "pytest", "testcontainers")


class _BenchmarkGroup(TyperGroup):
    """Imports the module of the benchmark that is run: some of them load torch."""

    def list_commands(self, _ctx: Any) -> list[str]:
        return list(MODULES)

    def get_command(self, _ctx: Any, name: str) -> Any:
        if name not in MODULES:
            return None
        benchmark = typer.Typer(add_completion=False)
        benchmark.command(name)(_import_benchmark(MODULES[name]).bench)
        return typer.main.get_command(benchmark)


app = typer.Typer(help="Run benchmarks on this machine.", cls=_BenchmarkGroup, no_args_is_help=True)


@app.callback()
def _callback() -> None:
    """Make a group of an application that declares no command itself."""


def _import_benchmark(module: str) -> Any:
    """Import a benchmark; Misconfigured (`no_benchmarks`) if a package of the tests is missing."""
    try:
        return importlib.import_module(f"lab.benchmarks.{module}")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in DEV_PACKAGES:
            raise
        raise Misconfigured(
            "no_benchmarks",
            "`placewise bench` requires a checkout of Placewise with the dev extra: "
            f"{error}. In the checkout, run make setup, then .venv/bin/placewise bench.",
        ) from error
