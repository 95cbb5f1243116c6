"""Transactions that PostgreSQL ends, and what is run again: deadlocks and nothing else."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from uuid import UUID

import pytest
from sqlalchemy import func, select, text
from sqlalchemy.exc import DBAPIError, IntegrityError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import Session

from shared.catalog.database import postgres as postgres_module
from shared.catalog.database.errors import to_unavailable
from shared.catalog.database.session import (
    MAX_TRANSACTION_ATTEMPTS,
    Catalog,
    PoolConfig,
    TransactionTimeouts,
)
from shared.catalog.maps import Map, lock_map
from tests.support.catalog_rows import add_map
from tests.support.servers import PostgresServer


@pytest.fixture
def catalog(postgres: PostgresServer, migrated_postgres: str) -> Iterator[Catalog]:
    opened = Catalog(
        postgres.new_database(migrated_postgres),
        PoolConfig(name="placewise-test", size=2, overflow=1, wait_seconds=0.2),
        TransactionTimeouts(statement_seconds=10, lock_seconds=5),
    )
    yield opened
    opened.close()


@pytest.fixture
def maps(catalog: Catalog) -> list[UUID]:
    with catalog.write() as session:
        return [add_map(session, name).id for name in ("a", "b")]


def test_deadlocked_transactions_are_retried_until_both_commit(
    catalog: Catalog, maps: list[UUID]
) -> None:
    both = threading.Barrier(2)
    runs: list[UUID] = []

    def unit_of(order: list[UUID]) -> None:
        def unit(session: Session) -> None:
            first = lock_map(session, order[0])
            if order[0] not in runs:  # its first run: the other holds its row, too
                runs.append(order[0])
                both.wait()
            else:
                runs.append(order[0])
            first.version += 1
            lock_map(session, order[1]).version += 1

        catalog.run(unit)

    with ThreadPoolExecutor() as pool:
        list(pool.map(unit_of, (maps, maps[::-1])))
    assert len(runs) == 3, "one of the two was sacrificed, and run once more"
    with catalog.read() as session:
        assert session.scalars(select(Map.version)).all() == [2, 2], "each unit counted once"


def test_serialization_failure_is_run_again_until_it_succeeds(
    catalog: Catalog, maps: list[UUID]
) -> None:
    runs = 0

    def unit(session: Session) -> int:
        nonlocal runs
        runs += 1
        session.execute(text("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ"))
        seen = session.get_one(Map, maps[0])
        if runs < 3:
            with catalog.write() as other:
                other.get_one(Map, maps[0]).version += 1
        seen.version += 100
        session.flush()
        return seen.version

    assert catalog.run(unit) == 102
    assert runs == 3


@pytest.mark.parametrize(
    ("state", "attempts", "code"),
    [
        ("40P01", MAX_TRANSACTION_ATTEMPTS, "catalog_busy"),
        ("23505", 1, None),  # a bug, or the caller's business
        ("55P03", 1, "catalog_busy"),
        ("53300", 1, "catalog_unavailable"),
    ],
)
def test_retries_of_a_deadlock_are_limited_and_every_other_error_is_raised_at_once(
    catalog: Catalog, state: str, attempts: int, code: str | None
) -> None:
    runs = 0

    def unit(session: Session) -> None:
        nonlocal runs
        runs += 1
        session.execute(text(f"DO $$ BEGIN RAISE EXCEPTION 'no' USING ERRCODE = '{state}'; END $$"))

    with pytest.raises(DBAPIError) as caught:
        catalog.run(unit)
    assert runs == attempts
    error = to_unavailable(caught.value)
    assert (error and error.code) == code


def test_limits_hold_inside_the_transaction_and_leave_nothing_behind(catalog: Catalog) -> None:
    """Behind a PgBouncer, what a transaction leaves behind another service would meet."""
    names = ("statement_timeout", "lock_timeout", "idle_in_transaction_session_timeout")
    with catalog.with_timeouts(
        TransactionTimeouts(statement_seconds=1.5, lock_seconds=0.5)
    ).read() as session:
        inside = [session.scalar(text(f"SHOW {name}")) for name in names]
        assert session.scalar(text("SHOW application_name")) == "placewise-test"
        prepared = text("SELECT count(*) FROM pg_prepared_statements")
        for _ in range(10):
            assert session.scalar(prepared) == 0
    assert inside == ["1500ms", "500ms", "1min"]
    with catalog.engine.connect() as connection:
        after = [connection.exec_driver_sql(f"SHOW {name}").scalar() for name in names]
    assert after == ["0", "0", "0"]


def test_statement_that_takes_too_long_is_ended_and_the_connection_stays_good(
    catalog: Catalog,
) -> None:
    quick = catalog.with_timeouts(TransactionTimeouts(statement_seconds=0.2, lock_seconds=60.0))
    with pytest.raises(OperationalError) as caught, quick.read() as session:
        session.execute(text("SELECT pg_sleep(30)"))
    error = to_unavailable(caught.value)
    assert error is not None
    assert error.code == "catalog_busy"
    with quick.read() as session:
        assert session.scalar(select(1)) == 1


def test_a_connection_that_died_while_it_was_not_used_is_replaced(
    catalog: Catalog, postgres: PostgresServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(postgres_module, "PING_AFTER_UNUSED_SECONDS", 0.0)
    with catalog.read() as session:
        dead = session.scalar(select(func.pg_backend_pid()))
    other = Catalog(catalog.url.render_as_string(hide_password=False))
    with other.write() as session:
        session.scalar(select(func.pg_terminate_backend(dead)))
    other.close()
    with catalog.write() as session:
        assert session.scalar(select(func.pg_backend_pid())) != dead


def add_two_maps(session: Session, name: str) -> None:
    for _ in range(2):
        add_map(session, name)


def test_transactions_after_autocommit_are_transactions(catalog: Catalog) -> None:
    """Migrations build indexes outside of a transaction, on a connection of the same pool."""
    with catalog.engine.connect() as connection:
        connection.execution_options(isolation_level="AUTOCOMMIT").exec_driver_sql("VACUUM maps")
    with pytest.raises(IntegrityError), catalog.write() as session:
        add_two_maps(session, "undone")
    with catalog.read() as session:
        assert session.scalars(select(Map.name)).all() == []
        with pytest.raises(DBAPIError, match="read-only"):
            add_map(session, "refused")


def test_no_free_connection_is_an_error_within_the_configured_wait(catalog: Catalog) -> None:
    with catalog.read() as a, catalog.read() as b, catalog.read() as c:
        for session in (a, b, c):
            session.scalar(select(1))
        with pytest.raises(PoolTimeout) as caught, catalog.read() as one_too_many:
            one_too_many.scalar(select(1))
    error = to_unavailable(caught.value)
    assert error is not None
    assert error.code == "catalog_busy"


def test_connection_in_use_while_the_catalog_closes_is_closed_when_it_is_returned(
    catalog: Catalog,
) -> None:
    with catalog.read() as session:
        driver = session.connection().connection.driver_connection
        catalog.close()
        assert session.scalar(select(1)) == 1
    assert driver is not None
    assert driver.closed
