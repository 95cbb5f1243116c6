"""Captures the SQL statements that are sent inside a block, with their plans and rows read."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import event

from shared.catalog.photo_search import MAX_COUNTED_MATCHES
from shared.catalog.session import Catalog

EXPLAINABLE = re.compile(r"\s*(SELECT|WITH|UPDATE|DELETE|INSERT)\b", re.IGNORECASE)
LARGE_TABLES = ("photos", "jobs", "descriptors", "searches")

# What may be read whatever is returned: counts stop at COUNTED_AT_MOST, of two tables at most.
MAX_ROWS_READ = 2 * MAX_COUNTED_MATCHES + 2_000
MAX_ROWS_READ_PER_RETURNED = 20


@dataclass(frozen=True, slots=True)
class StatementPlan:
    """Plan of a statement: `read` is the number of rows scanned, `milliseconds` server time."""

    call: str
    sql: str
    scans: tuple[str, ...]
    read: int
    returned: int
    milliseconds: float
    sequential: tuple[str, ...]
    """Large tables that were read from one end to the other."""

    def faults(self) -> list[str]:
        found = [f"sequential scan over {table}" for table in self.sequential]
        if self.read > max(MAX_ROWS_READ, MAX_ROWS_READ_PER_RETURNED * self.returned):
            found.append(f"reads {self.read:,} rows to return {self.returned:,}")
        return found


@dataclass
class Explainer:
    """Explains the statements that are sent through the catalog during `call`."""

    catalog: Catalog
    small: bool = False
    """Reading everything is cheap, so the planner would: what matters is that it need not. Scans
    and joins of whole tables are forbidden; a walk through a whole index shows in what is read."""
    found: list[StatementPlan] = field(default_factory=list)

    @contextlib.contextmanager
    def call(self, name: str) -> Iterator[None]:
        seen: set[str] = set()

        def before(
            connection: Any, _cursor: Any, sql: str, parameters: Any, _context: Any, many: bool
        ) -> None:
            if many or sql in seen or not EXPLAINABLE.match(sql) or "pg_catalog" in sql:
                return
            seen.add(sql)
            self.found.append(self._explain(connection, name, sql, parameters))

        event.listen(self.catalog.engine, "before_cursor_execute", before)
        try:
            yield
        finally:
            event.remove(self.catalog.engine, "before_cursor_execute", before)

    def _explain(self, connection: Any, call: str, sql: str, parameters: Any) -> StatementPlan:
        # In its own transaction, so on the very rows; and undone, so that it changes nothing.
        with connection.connection.cursor() as cursor:
            cursor.execute("SAVEPOINT explained")
            if self.small:
                for method in ("seqscan", "hashjoin", "mergejoin"):
                    cursor.execute(f"SET LOCAL enable_{method} = off")
            cursor.execute(f"EXPLAIN (ANALYZE, FORMAT JSON) {sql}", parameters)
            plan = cursor.fetchone()[0][0]
            cursor.execute("ROLLBACK TO SAVEPOINT explained")
        nodes = list(_plan_nodes(plan["Plan"]))
        scans = [node for node in nodes if "Relation Name" in node and "Scan" in node["Node Type"]]
        return StatementPlan(
            call=call,
            sql=" ".join(sql.split()),
            scans=tuple(_node_label(node) for node in nodes if "Scan" in node["Node Type"]),
            read=sum(_rows_read(node) for node in scans),
            returned=_rows_returned(plan["Plan"]),
            milliseconds=plan["Planning Time"] + plan["Execution Time"],
            sequential=tuple(
                node["Relation Name"]
                for node in scans
                if node["Node Type"] == "Seq Scan"
                and node["Relation Name"] in LARGE_TABLES
                and _rows_read(node) > MAX_ROWS_READ
            ),
        )


def _plan_nodes(plan: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield plan
    for child in plan.get("Plans", ()):
        yield from _plan_nodes(child)


def _rows_read(node: dict[str, Any]) -> int:
    removed = node.get("Rows Removed by Filter", 0) + node.get("Rows Removed by Index Recheck", 0)
    return int((node["Actual Rows"] + removed) * node["Actual Loops"])


def _rows_returned(plan: dict[str, Any]) -> int:
    """Return the number of result rows; for a data change, the number of affected rows."""
    if plan["Node Type"] == "ModifyTable":
        return max((_rows_returned(child) for child in plan.get("Plans", ())), default=1)
    return int(plan["Actual Rows"])


def _node_label(node: dict[str, Any]) -> str:
    on = node.get("Index Name") or node.get("Relation Name") or node.get("CTE Name") or ""
    return f"{node['Node Type']} {on}".strip()
