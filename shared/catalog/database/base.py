"""Declarative base, column types and SQL functions shared by the catalog's tables.

Leases and ages use the database's clock only, so that a worker with a wrong clock can neither steal
nor keep a lease: `db_now()` and `db_now_plus(seconds)` are SQL expressions. `Journaled` marks rows
that are not yet in the journal of the object store (`shared.journal`); `to_json` and `from_json`
convert column values, with the same result from SQLite and PostgreSQL.
"""

from __future__ import annotations

import base64
from datetime import UTC, datetime
from typing import Any, TypeVar
from uuid import UUID

import sqlalchemy as sa
from sqlalchemy.dialects.postgresql import ARRAY, JSONB
from sqlalchemy.exc import IntegrityError
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column
from sqlalchemy.sql.elements import ColumnElement
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import Boolean, Float, Text, TypeDecorator

from shared.errors import NotFound
from shared.geodesy import EARTH_RADIUS_M, flush_to_zero
from shared.ids import new_id

SQLITE_DISTANCE_FUNCTION = "placewise_distance_m"

Condition = ColumnElement[bool]
Row = TypeVar("Row")


class UtcDateTime(TypeDecorator[datetime]):
    """An aware UTC datetime in Python; `timestamptz` in PostgreSQL, sortable text in SQLite."""

    impl = sa.DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: sa.Dialect) -> datetime | None:
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"a time without an offset can't be stored: {value!r}")
        value = value.astimezone(UTC)
        return value.replace(tzinfo=None) if dialect.name == "sqlite" else value

    def process_result_value(self, value: datetime | None, dialect: sa.Dialect) -> datetime | None:
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class CoordinateColumn(TypeDecorator[float]):
    """A latitude or longitude; denormally small values are stored as 0."""

    impl = Float
    cache_ok = True

    def process_bind_param(self, value: float | None, dialect: sa.Dialect) -> float | None:
        return None if value is None else flush_to_zero(value)


JsonValue = sa.JSON(none_as_null=True).with_variant(JSONB(none_as_null=True), "postgresql")


class Base(DeclarativeBase):
    """Declarative base of all tables; constraints get fixed names."""

    metadata = sa.MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class Entity(Base):
    """Base of the tables whose rows have an id: a UUIDv7, by which they are in order of age."""

    __abstract__ = True

    id: Mapped[UUID] = mapped_column(sa.Uuid, primary_key=True, default=new_id, sort_order=-1)


def partial_index(name: str, *columns: Any, only: Condition, unique: bool = False) -> sa.Index:
    """Return a partial index of the rows that match `only`."""
    return sa.Index(name, *columns, unique=unique, postgresql_where=only, sqlite_where=only)


class db_now(FunctionElement[datetime]):
    """The database's time at the start of the statement (not of the transaction)."""

    type = UtcDateTime()
    inherit_cache = True


class db_now_plus(FunctionElement[datetime]):
    """The database's time plus a number of seconds, which may be negative."""

    type = UtcDateTime()
    inherit_cache = True


class json_array_has(FunctionElement[bool]):
    """True where a JSON array column contains a string: `json_array_has(Photo.tags, "night")`."""

    type = Boolean()
    inherit_cache = True


class json_array_has_part(FunctionElement[bool]):
    """True where a string of a JSON array column contains a text, ASCII letters in either case.

    The same strings as `photo_filter.is_part_of_tag`: `json_array_has_part(Photo.tags, "night")`.
    """

    type = Boolean()
    inherit_cache = True


class filename_trigrams(FunctionElement[Any]):
    """The case-folded trigrams of a text, for an index that serves substring searches.

    PostgreSQL only. The SQL function is created with the tables, so that the extension pg_trgm is
    not required.
    """

    type = ARRAY(Text())
    inherit_cache = True


class db_distance_m(FunctionElement[float]):
    """`geodesy.distance_m` in SQL: latitude and longitude of two points, in degrees."""

    type = Float()
    inherit_cache = True


@compiles(db_now, "postgresql")
def _now_postgresql(element: db_now, compiler: Any, **kw: Any) -> str:
    # Not clock_timestamp(): an index can't be used for a value that changes within a statement.
    return "statement_timestamp()"


@compiles(db_now, "sqlite")
def _now_sqlite(element: db_now, compiler: Any, **kw: Any) -> str:
    # SQLite returns milliseconds and SQLAlchemy stores microseconds: padded, so that text sorts
    # by time.
    return "(strftime('%Y-%m-%d %H:%M:%f', 'now') || '000')"


@compiles(db_now_plus, "postgresql")
def _now_plus_postgresql(element: db_now_plus, compiler: Any, **kw: Any) -> str:
    seconds = compiler.process(element.clauses, **kw)
    return f"(statement_timestamp() + make_interval(secs => CAST({seconds} AS double precision)))"


@compiles(db_now_plus, "sqlite")
def _now_plus_sqlite(element: db_now_plus, compiler: Any, **kw: Any) -> str:
    seconds = compiler.process(element.clauses, **kw)
    return f"(strftime('%Y-%m-%d %H:%M:%f', 'now', ({seconds}) || ' seconds') || '000')"


@compiles(json_array_has, "postgresql")
def _json_array_has_postgresql(element: json_array_has, compiler: Any, **kw: Any) -> str:
    array, value = element.clauses
    array_sql, value_sql = compiler.process(array, **kw), compiler.process(value, **kw)
    return f"({array_sql} @> jsonb_build_array(CAST({value_sql} AS text)))"


@compiles(json_array_has, "sqlite")
def _json_array_has_sqlite(element: json_array_has, compiler: Any, **kw: Any) -> str:
    array, value = element.clauses
    array_sql, value_sql = compiler.process(array, **kw), compiler.process(value, **kw)
    return f"EXISTS (SELECT 1 FROM json_each({array_sql}) WHERE json_each.value = {value_sql})"  # noqa: S608  (compiled SQL, no text of users)


@compiles(json_array_has_part, "postgresql")
def _json_array_has_part_postgresql(element: json_array_has_part, compiler: Any, **kw: Any) -> str:
    array, part = (compiler.process(clause, **kw) for clause in element.clauses)
    # In the collation "C", lower() changes ASCII letters only.
    return (
        f"EXISTS (SELECT 1 FROM jsonb_array_elements_text({array}) AS item(text) WHERE "  # noqa: S608  (compiled SQL, no text of users)
        f'strpos(lower(item.text COLLATE "C"), lower(CAST({part} AS text) COLLATE "C")) > 0)'
    )


@compiles(json_array_has_part, "sqlite")
def _json_array_has_part_sqlite(element: json_array_has_part, compiler: Any, **kw: Any) -> str:
    array, part = (compiler.process(clause, **kw) for clause in element.clauses)
    return (
        f"EXISTS (SELECT 1 FROM json_each({array}) WHERE "  # noqa: S608  (compiled SQL, no text of users)
        f"instr(lower(json_each.value), lower({part})) > 0)"
    )


sa.event.listen(
    Base.metadata,
    "before_create",
    sa.DDL(  # type: ignore[no-untyped-call]
        "CREATE OR REPLACE FUNCTION placewise_trigrams(text) RETURNS text[] "
        "LANGUAGE sql IMMUTABLE STRICT PARALLEL SAFE AS $$"
        "SELECT array_agg(substr(lower($1), i, 3))"
        " FROM generate_series(1, length(lower($1)) - 2) AS i"
        "$$"
    ).execute_if(dialect="postgresql"),
)


@compiles(filename_trigrams)
def _filename_trigrams(element: filename_trigrams, compiler: Any, **kw: Any) -> str:
    return f"placewise_trigrams({compiler.process(element.clauses, **kw)})"


@compiles(db_distance_m, "postgresql")
def _distance_postgresql(element: db_distance_m, compiler: Any, **kw: Any) -> str:
    lat_1, lon_1, lat_2, lon_2 = (
        f"CAST({compiler.process(clause, **kw)} AS double precision)" for clause in element.clauses
    )
    shrunk = f"cos(radians({lat_1})) * cos(radians({lat_2}))"
    half_lambda = f"radians({lon_2} - {lon_1}) / 2"
    return (
        f"({2 * EARTH_RADIUS_M!r} * atan2("
        f"sqrt(sin(radians({lat_2} - {lat_1}) / 2) ^ 2 + {shrunk} * sin({half_lambda}) ^ 2), "
        f"sqrt(sin(radians({lat_2} + {lat_1}) / 2) ^ 2 + {shrunk} * cos({half_lambda}) ^ 2)))"
    )


@compiles(db_distance_m, "sqlite")
def _distance_sqlite(element: db_distance_m, compiler: Any, **kw: Any) -> str:
    # SQLite may be built without trigonometry: `session` registers this function with each
    # connection.
    return f"{SQLITE_DISTANCE_FUNCTION}({compiler.process(element.clauses, **kw)})"


def for_update(statement: sa.Select[Row]) -> sa.Select[Row]:
    """Lock the rows of a SELECT until the end of the transaction, and refresh loaded objects."""
    return statement.with_for_update().execution_options(populate_existing=True)


def list_newest(
    session: Session,
    table: type[Row],
    *conditions: Condition,
    limit: int | None = None,
    before: UUID | None = None,
) -> list[Row]:
    """List up to `limit` rows by descending id (UUIDv7: newest first), all by default.

    Args:
        before: Cursor: the last id of the previous page, if any.
    """
    id_column: Any = table.id  # type: ignore[attr-defined]
    statement = sa.select(table).where(*conditions).order_by(id_column.desc()).limit(limit)
    if before is not None:
        statement = statement.where(id_column < before)
    return list(session.scalars(statement))


def get_in_map(
    session: Session, table: type[Row], map_id: UUID, row_id: UUID, *, lock: bool = False
) -> Row:
    """Return a row by its id and its map; NotFound (`job_not_found` for the table of jobs)."""
    columns: Any = table
    statement = sa.select(table).where(columns.id == row_id, columns.map_id == map_id)
    row = session.scalar(for_update(statement) if lock else statement)
    if row is None:
        noun = table.__name__.lower()
        raise NotFound(
            f"{noun}_not_found",
            f"There is no {noun} {row_id} in this map.",
            **{f"{noun}_id": str(row_id)},
        )
    return row


def insert_row(session: Session, row: Row) -> Row:
    """Insert a row at once, and return it with its id."""
    session.add(row)
    session.flush()
    return row


def get_or_insert(session: Session, statement: sa.Select[Row], row: Row) -> Row:
    """Return the row that `statement` selects; if there is none, insert and return `row`."""
    existing = session.scalar(statement)
    if existing is not None:
        return existing
    try:
        with session.begin_nested():
            return insert_row(session, row)
    except IntegrityError:  # another process inserted it between the two statements
        return session.scalars(statement).one()


def count_rows(session: Session, statement: sa.Select[Any], limit: int | None = None) -> int:
    """Count the rows of a SELECT, up to `limit`."""
    one_each = statement.with_only_columns(sa.literal(1), maintain_column_froms=True)
    rows = one_each.limit(limit).subquery()
    return session.scalar(sa.select(sa.func.count()).select_from(rows)) or 0


def affected_rows(result: Any) -> int:
    """Return the number of rows that an UPDATE or DELETE affected."""
    return int(result.rowcount)


class Journaled:
    """Mixin of tables whose rows are written to the journal.

    Every INSERT and UPDATE through SQLAlchemy increments `revision` in the same transaction. A row
    whose `revision` differs from `journaled_revision` is pending.
    """

    revision: Mapped[int] = mapped_column(
        sa.BigInteger, default=1, server_default="1", onupdate=sa.text("revision + 1")
    )
    journaled_revision: Mapped[int] = mapped_column(sa.BigInteger, default=0, server_default="0")


def is_journaled(table: type[Journaled]) -> Condition:
    """Condition for rows whose current state is in the journal."""
    return table.revision == table.journaled_revision


def to_json(value: Any) -> Any:
    """Convert a column's value to JSON: UUIDs, times and bytes (base64) become text."""
    if isinstance(value, UUID):
        return str(value)
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, datetime):
        return value.isoformat()
    return value


def from_json(column: sa.Column[Any], value: Any) -> Any:
    """Convert a JSON value of `to_json` back to the value of `column`."""
    if value is None:
        return None
    if isinstance(column.type, sa.Uuid):
        return UUID(value)
    if isinstance(column.type, UtcDateTime):
        return datetime.fromisoformat(value)
    if isinstance(column.type, sa.LargeBinary):
        return base64.b64decode(value)
    return value
