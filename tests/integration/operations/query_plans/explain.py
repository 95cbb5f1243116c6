"""Captures the SQL statements that are sent inside a block, with their plans and rows read."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import event

from services.gateway.photo_search import MAX_COUNTED_MATCHES
from shared.catalog.database.session import Catalog

EXPLAINABLE = re.compile(r"\s*(SELECT|WITH|UPDATE|DELETE|INSERT)\b", re.IGNORECASE)
LARGE_TABLES = ("photos", "jobs", "descriptors", "searches")

# Rows that a statement may read whatever it returns: it counts the rows of at most two tables, and
# a count stops at MAX_COUNTED_MATCHES.
MAX_ROWS_READ = 2 * MAX_COUNTED_MATCHES + 2_000
MAX_ROWS_READ_PER_RETURNED = 20


@dataclass(frozen=True, slots=True)
class StatementPlan:
    """Plan of a statement: `read` is the number of rows scanned."""

    call: str
    sql: str
    scans: tuple[str, ...]
    read: int
    returned: int
    sequential: tuple[str, ...]
    """Large tables that were read completely."""

    def faults(self) -> list[str]:
        """Describe what makes the statement slow on a large catalog; empty if nothing does."""
        faults = [f"sequential scan over {table}" for table in self.sequential]
        if self.read > max(MAX_ROWS_READ, MAX_ROWS_READ_PER_RETURNED * self.returned):
            faults.append(f"reads {self.read:,} rows to return {self.returned:,}")
        return faults


@dataclass
class Explainer:
    """Explains the statements that are sent through the catalog during `call`.

    The tables are small: a planner would scan them, because that is cheap. Sequential scans and
    hash and merge joins are disabled, so that the plan shows whether an index can be used.
    """

    catalog: Catalog
    plans: list[StatementPlan] = field(default_factory=list)

    @contextlib.contextmanager
    def call(self, name: str) -> Iterator[None]:
        """Collect the plans of the statements that are sent inside the block under this name."""
        seen: set[str] = set()

        def before(
            connection: Any, _cursor: Any, sql: str, parameters: Any, _context: Any, many: bool
        ) -> None:
            if many or sql in seen or not EXPLAINABLE.match(sql) or "pg_catalog" in sql:
                return
            seen.add(sql)
            self.plans.append(self._explain(connection, name, sql, parameters))

        event.listen(self.catalog.engine, "before_cursor_execute", before)
        try:
            yield
        finally:
            event.remove(self.catalog.engine, "before_cursor_execute", before)

    def _explain(self, connection: Any, call: str, sql: str, parameters: Any) -> StatementPlan:
        # In the caller's transaction, if any, so that it reads the same rows; rolled back.
        driver = connection.connection.driver_connection
        with driver.transaction(force_rollback=True), driver.cursor() as cursor:
            for method in ("seqscan", "hashjoin", "mergejoin"):
                cursor.execute(f"SET LOCAL enable_{method} = off")
            cursor.execute(f"EXPLAIN (ANALYZE, FORMAT JSON) {sql}", parameters)
            plan = cursor.fetchone()[0][0]
        nodes = list(_plan_nodes(plan["Plan"]))
        scans = [node for node in nodes if "Relation Name" in node and "Scan" in node["Node Type"]]
        return StatementPlan(
            call=call,
            sql=" ".join(sql.split()),
            scans=tuple(_node_label(node) for node in nodes if "Scan" in node["Node Type"]),
            read=sum(_rows_read(node) for node in scans),
            returned=_rows_returned(plan["Plan"]),
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
