"""One cache of compiled SQL statements for the catalogs of all tests of a process.

SQLAlchemy compiles a statement once for each dialect object, and each engine has its own: a test
would compile all of its statements again, a tenth of its CPU time.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy.engine import Dialect, Engine

_dialects: dict[str, Dialect] = {}
_compiled: dict[Any, Any] = {}


def share_compiled_statements(engine: Engine) -> None:
    """Let the engine compile by the dialect of the first engine of its database."""
    if engine.name not in _dialects:
        engine.connect().close()  # reads the version of the database into the dialect
        _dialects[engine.name] = engine.dialect
    engine.dialect = _dialects[engine.name]
    engine.update_execution_options(compiled_cache=_compiled)
