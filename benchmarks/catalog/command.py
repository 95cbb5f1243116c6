"""`placewise bench catalog`."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import psycopg
import typer
from psycopg.sql import SQL, Identifier
from rich.table import Table
from sqlalchemy.engine import URL, make_url

from benchmarks.catalog.calls import KNOWN_FULL_SCANS, run_all_calls
from benchmarks.catalog.explain import Explainer
from benchmarks.catalog.fill import fill_catalog
from services.cli.configuration import read_settings
from services.cli.output import JsonOption, console, err_console, print_json, report_errors
from shared.catalog.connections import PoolConfig, TransactionTimeouts
from shared.catalog.schema import migrate
from shared.catalog.session import Catalog
from shared.errors import Misconfigured
from shared.ids import new_id


def bench_catalog(
    photos: Annotated[int, typer.Option(min=100_000, help="rows to make")] = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Fill a PostgreSQL with photos and explain every statement that the services send.

    On the server of DATABASE_URL, in a database of its own, which is dropped in the end. Exit code
    1 when a statement reads a large table from end to end, or far more than it returns.
    """
    with report_errors(as_json):
        url = make_url(read_settings().catalog_url())
        if url.get_backend_name() != "postgresql":
            raise Misconfigured("postgres_missing", "Set DATABASE_URL to a PostgreSQL to fill.")
        with _create_database(url) as own, tempfile.TemporaryDirectory() as folder:
            catalog = Catalog(
                own, PoolConfig(name="placewise-bench"), TransactionTimeouts(3600, 3600)
            )
            try:
                migrate(catalog)
                started = time.perf_counter()
                filled = fill_catalog(catalog, photos)
                err_console.print(
                    f"{photos:,} photos made in {time.perf_counter() - started:.0f} s"
                )
                explainer = Explainer(catalog)
                for name in run_all_calls(catalog, filled, explainer, Path(folder)):
                    err_console.print(f"  {name}", soft_wrap=True)
            finally:
                catalog.close()
    faulty = [e for e in explainer.found if e.faults() and e.call not in KNOWN_FULL_SCANS]
    if as_json:
        statements = [{**asdict(e), "faults": e.faults()} for e in explainer.found]
        print_json({"photos": photos, "tables": filled.tables, "statements": statements})
    else:
        table = Table("call", "ms", "read", "returned", "scans")
        for e in explainer.found:
            style = "red" if e in faulty else None
            table.add_row(
                e.call,
                f"{e.milliseconds:.1f}",
                f"{e.read:,}",
                f"{e.returned:,}",
                ", ".join(e.scans),
                style=style,
            )
        console.print(table)
        for name, size_bytes in sorted(filled.tables.items(), key=lambda item: -item[1]):
            console.print(f"{name}: {size_bytes / photos:,.0f} bytes per photo")
        for e in faulty:
            console.print(f"[red]{e.call}[/red]: {'; '.join(e.faults())}\n  {e.sql}")
    if faulty:
        raise typer.Exit(1)


@contextlib.contextmanager
def _create_database(url: URL) -> Iterator[str]:
    """The URL of a new database on the same server."""
    name = f"placewise_bench_{new_id().hex}"
    admin = url.set(drivername="postgresql").render_as_string(hide_password=False)
    with psycopg.connect(admin, autocommit=True) as connection:
        connection.execute(SQL("CREATE DATABASE {}").format(Identifier(name)))
    try:
        yield url.set(database=name).render_as_string(hide_password=False)
    finally:
        with psycopg.connect(admin, autocommit=True) as connection:
            connection.execute(SQL("DROP DATABASE {} WITH (FORCE)").format(Identifier(name)))
