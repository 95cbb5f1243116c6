"""The catalog's rows as JSON lines, the same from SQLite and PostgreSQL."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sqlalchemy import Table, func, insert, select
from sqlalchemy.orm import Session

import shared.catalog.tables  # noqa: F401  (every table has to be known)
from shared.catalog.base import Base
from shared.catalog.direct_uploads import PresignedUpload
from shared.catalog.installation import Installation
from shared.catalog.live_processes import RegisteredProcess
from shared.catalog.row_json import from_json, to_json
from shared.catalog.schema_compatibility import SchemaCompatibility
from shared.catalog.search_workers import RegisteredSearchWorker
from shared.errors import Misconfigured
from shared.private_files import FILE_MODE, FOLDER_MODE

ROWS_PER_STATEMENT = 1000
GZIP_LEVEL = 1  # of gzip: rows shrink to a fifth, and the disk stays the slower part

# What says nothing elsewhere or later: who is alive now, addresses that expire, the schema's own.
EXCLUDED_TABLES = frozenset(
    table.__tablename__
    for table in (RegisteredSearchWorker, RegisteredProcess, PresignedUpload, SchemaCompatibility)
)
# The target has its own: `shared.backup.restore`.
NOT_RESTORED_TABLES = frozenset({Installation.__tablename__})

BackupProgress = Callable[[str, int, int], object]
"""Told what is done, how much of it, and of how much."""


def backup_tables() -> list[Table]:
    """Those that a backup holds; each comes after those that its foreign keys lead to."""
    return [table for table in Base.metadata.sorted_tables if table.name not in EXCLUDED_TABLES]


def dump_rows(session: Session, folder: Path, progress: BackupProgress) -> dict[str, int]:
    """Every row into `<table>.jsonl.gz`; how many each table has."""
    folder.mkdir(FOLDER_MODE)
    counts = {}
    for table in backup_tables():
        total = session.scalar(select(func.count()).select_from(table)) or 0
        done = 0
        rows = session.execute(select(table).execution_options(yield_per=ROWS_PER_STATEMENT))
        file = folder / f"{table.name}.jsonl.gz"
        file.touch(FILE_MODE)
        with gzip.open(file, "wt", compresslevel=GZIP_LEVEL) as lines:
            for row in rows.mappings():
                values = {name: to_json(value) for name, value in row.items()}
                lines.write(json.dumps(values, ensure_ascii=False) + "\n")
                done += 1
                if done % ROWS_PER_STATEMENT == 0:
                    progress(f"rows of {table.name}", done, total)
        counts[table.name] = done
        progress(f"rows of {table.name}", done, done)
    return counts


def load_rows(
    session: Session, folder: Path, counts: dict[str, int], progress: BackupProgress
) -> None:
    """Insert what `dump_rows` has written. Misconfigured (`backup_damaged`) when a table has other
    than `counts` rows, or can't be read."""
    for table in backup_tables():
        if table.name in NOT_RESTORED_TABLES:
            continue
        done = 0
        try:
            for some in _read(folder / f"{table.name}.jsonl.gz", table):
                session.execute(insert(table), some)
                done += len(some)
                progress(f"rows of {table.name}", done, counts[table.name])
        except (OSError, EOFError, ValueError, KeyError) as error:
            raise _damaged_error(table, str(error)) from error
        if done != counts.get(table.name):
            raise _damaged_error(table, f"{done} rows of {counts.get(table.name)}")


def _read(file: Path, table: Table) -> Iterator[list[dict[str, Any]]]:
    some: list[dict[str, Any]] = []
    with gzip.open(file, "rt") as lines:
        for line in lines:
            values = json.loads(line)
            some.append({c.name: from_json(c, values[c.name]) for c in table.columns})
            if len(some) == ROWS_PER_STATEMENT:
                yield some
                some = []
    if some:
        yield some


def _damaged_error(table: Table, why: str) -> Misconfigured:
    return Misconfigured(
        "backup_damaged",
        f"The rows of {table.name} in the backup are not what was written ({why}). Take another "
        "backup.",
    )
