"""SQL statements that are compiled once for each kind of database, not for each test's catalog."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from sqlalchemy.dialects.postgresql.psycopg import PGDialect_psycopg
from sqlalchemy.dialects.sqlite.pysqlite import SQLiteDialect_pysqlite
from sqlalchemy.engine import Engine
from sqlalchemy.util import LRUCache

STATEMENTS = 5000


def share_compiled_statements() -> None:
    """Let all engines of this process use what one of them has compiled.

    Each test has an engine of its own, and compiling is an eighth of the CPU time of the tests of
    services. SQLAlchemy looks a statement up by its text and its dialect, of which each engine
    has one.
    """
    caches: dict[type, LRUCache[Any, Any]] = defaultdict(lambda: LRUCache(STATEMENTS))
    create = Engine.__init__

    def share(engine: Engine, *arguments: Any, **options: Any) -> None:
        create(engine, *arguments, **options)
        engine._compiled_cache = caches[type(engine.dialect)]

    Engine.__init__ = share  # type: ignore[assignment, method-assign]
    for dialect in (SQLiteDialect_pysqlite, PGDialect_psycopg):
        dialect.__hash__ = lambda self: hash(type(self))  # type: ignore[method-assign]
        dialect.__eq__ = lambda self, other: type(self) is type(other)  # type: ignore[method-assign]
