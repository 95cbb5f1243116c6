"""Which tables the journal holds, and their rows as lines."""

from __future__ import annotations

from typing import Any

from sqlalchemy import RowMapping, Table

from shared.catalog.generations import Generation
from shared.catalog.journaled import Journaled
from shared.catalog.maps import Map
from shared.catalog.models import Model
from shared.catalog.photos import Photo
from shared.catalog.row_json import from_json, to_json
from shared.catalog.vocabularies import Vocabulary
from shared.catalog.whitenings import StoredWhitening
from shared.journal.segments import Line

# Each after those that its foreign keys lead to.
TABLES: dict[str, type[Journaled]] = {
    "models": Model,
    "maps": Map,
    "vocabularies": Vocabulary,
    "whitenings": StoredWhitening,
    "generations": Generation,
    "photos": Photo,
}

# Of the catalog's own bookkeeping: they mean nothing in another one.
LEFT_OUT = {
    "photos": {"job_id", "changed_version"},
    "maps": {"version"},
    "generations": {"open_slot", "open_slot_rows", "complete_version", "complete_at"},
}
MARKS = {"revision", "journaled_revision"}


def table_of(name: str) -> Table:
    """The table; KeyError for one that the journal does not hold."""
    table = TABLES[name].__table__  # type: ignore[attr-defined]
    assert isinstance(table, Table)
    return table


def line_of(name: str, row: RowMapping) -> Line:
    """The row's present state."""
    left_out = MARKS | LEFT_OUT.get(name, set())
    values = {key: to_json(value) for key, value in row.items() if key not in left_out}
    return Line(name, row["id"], row["revision"], values)


def columns_of(line: Line) -> dict[str, Any]:
    """The row's columns, by name, without the marks; columns that this release does not know are
    left out."""
    table = table_of(line.table)
    known = {c.name: c for c in table.columns}
    return {
        name: from_json(known[name], value) for name, value in line.row.items() if name in known
    }
