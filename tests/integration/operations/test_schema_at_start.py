"""What a process makes of the catalog's tables at its start: none, its own, or other ones."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
from sqlalchemy import make_url

from shared.catalog.database import schema
from shared.catalog.database.schema import check_schema, migrate, wait_for_schema
from shared.catalog.database.session import Catalog, PoolConfig, TransactionTimeouts
from shared.errors import Misconfigured, Unavailable
from tests.support.servers import PostgresServer
from tests.support.threads import at_once


@pytest.fixture
def catalog(postgres: PostgresServer) -> Iterator[Catalog]:
    opened = Catalog(postgres.new_database(), PoolConfig(), TransactionTimeouts(5, 3))
    yield opened
    opened.close()


def test_processes_that_migrate_at_once_create_the_tables_once(catalog: Catalog) -> None:
    at_once(*[partial(migrate, catalog)] * 4)
    check_schema(catalog)


def test_a_migration_that_does_not_end_is_waited_for_only_so_long(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(schema, "MIGRATION_TIMEOUTS", TransactionTimeouts(0, 0.2))
    with catalog.engine.begin() as connection:
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({schema.ADVISORY_LOCK_ID})")
        with pytest.raises(Unavailable) as caught:
            migrate(catalog)
    assert caught.value.code == "catalog_busy"


def test_service_waits_for_the_migration_and_then_starts(catalog: Catalog) -> None:
    with pytest.raises(Misconfigured, match="placewise storage migrate") as caught:
        wait_for_schema(catalog, 0.1)
    assert caught.value.code == "schema_missing"
    waiting = threading.Thread(target=wait_for_schema, args=(catalog, 60))
    waiting.start()
    migrate(catalog)
    waiting.join(timeout=30)
    assert not waiting.is_alive()


def test_the_tables_of_another_version_are_refused_at_once_and_stay_as_they_are(
    catalog: Catalog,
) -> None:
    migrate(catalog)
    with catalog.engine.begin() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '0029'")
    for start in (migrate, lambda catalog: wait_for_schema(catalog, 60)):
        with pytest.raises(Misconfigured, match="let DATABASE_URL name an empty") as caught:
            start(catalog)
        assert caught.value.code == "schema_differs"
        assert "schema 0029;" in caught.value.detail


@pytest.mark.parametrize(
    ("address", "named"),
    [
        ("nobody@127.0.0.1:1/none", "database none at 127.0.0.1:1"),
        ("/none?host=/nowhere", "database none at /nowhere"),
    ],
)
def test_an_unreachable_catalog_is_waited_for(address: str, named: str) -> None:
    nowhere = Catalog(f"postgresql+psycopg://{address}", PoolConfig(connect_seconds=2))
    with pytest.raises(Unavailable) as caught:
        wait_for_schema(nowhere, 0.1)
    assert caught.value.code == "catalog_unavailable"
    assert named in caught.value.detail
    assert "refused" in caught.value.detail or "No such file" in caught.value.detail
    assert "This may pass" in caught.value.detail
    nowhere.close()


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"database": "nowhere"}, 'database "nowhere" does not exist'),
        ({"username": "nobody_knows"}, "nobody_knows"),
    ],
)
def test_a_connection_that_can_never_work_is_not_waited_for(
    postgres: PostgresServer, changed: dict[str, Any], reason: str
) -> None:
    url = make_url(postgres.new_database()).set(**changed)
    wrong = Catalog(url.render_as_string(hide_password=False))
    started = time.monotonic()
    with pytest.raises(Unavailable) as caught:
        wait_for_schema(wrong, 500)
    assert time.monotonic() - started < 100
    assert caught.value.code == "catalog_unavailable"
    assert reason in caught.value.detail
    assert f"database {url.database} at {url.host}" in caught.value.detail
    assert "will not pass by itself" in caught.value.detail
    wrong.close()
