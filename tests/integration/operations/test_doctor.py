"""The doctor's look at separate services: what is well, and what to do about what is not."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from typing import Any

import pytest
from sqlalchemy import update

from services.cli.operations import deployment_checks as server_checks
from services.cli.operations.deployment_checks import (
    check_gateway,
    check_object_store,
    check_postgres,
    check_processes,
    check_redis,
    check_search,
    check_steward,
)
from services.cli.operations.installation_checks import _check_photos
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import JobState
from shared.catalog.processes import RegisteredProcess, list_processes, process_heartbeat
from shared.config.settings import Settings
from shared.config.shards import Shard
from shared.errors import Misconfigured, PlacewiseError, Unavailable
from shared.storage import FolderStore
from tests.support.catalog_rows import add_job, add_map, add_photo, set_columns, take
from tests.support.search_tier import SearchServer
from tests.support.servers import PostgresServer, RedisServer


@pytest.fixture
def deployed(
    postgres: PostgresServer, migrated_postgres: str, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Catalog]:
    url = postgres.new_database(migrated_postgres)
    monkeypatch.setenv("DATABASE_URL", url)
    opened = Catalog(url)
    yield opened
    opened.close()


def refused(check: Any, *arguments: Any) -> PlacewiseError:
    with pytest.raises(PlacewiseError) as caught:
        check(*arguments)
    return caught.value


def test_postgres_that_can_not_be_used_is_refused_with_the_reason(
    deployed: Catalog, postgres: PostgresServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "schema up to date" in check_postgres(Settings())
    monkeypatch.setattr(server_checks, "MAX_CLOCK_SKEW_SECONDS", -1.0)
    assert refused(check_postgres, Settings()).code == "clocks_differ"
    monkeypatch.setattr(server_checks, "MIN_POSTGRES_VERSION", 10**9)
    assert refused(check_postgres, Settings()).code == "postgres_too_old"
    monkeypatch.setattr(server_checks, "MIN_POSTGRES_VERSION", 0)
    monkeypatch.setenv("DATABASE_URL", postgres.new_database())
    assert refused(check_postgres, Settings()).code == "schema_outdated"
    monkeypatch.setenv("DATABASE_URL", "postgresql+psycopg://nobody:x@127.0.0.1:1/none")
    assert refused(check_postgres, Settings()).code == "catalog_unavailable"


def test_redis_that_can_not_be_used_is_refused_with_the_reason(
    redis: RedisServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert refused(check_redis, Settings()).code == "redis_missing"
    monkeypatch.setenv("REDIS_URL", redis.url)
    assert "answers" in check_redis(Settings())
    monkeypatch.setattr(server_checks, "MIN_REDIS_VERSION", (999, 0))
    assert refused(check_redis, Settings()).code == "redis_too_old"
    monkeypatch.setenv("REDIS_URL", "redis://127.0.0.1:1/0")
    gone = refused(check_redis, Settings())
    assert isinstance(gone, Unavailable)
    assert "Start it" in gone.detail


def test_objects_are_written_read_and_deleted(monkeypatch: pytest.MonkeyPatch) -> None:
    reported = check_object_store(Settings())
    assert "wrote, read, listed and deleted" in reported
    store = FolderStore(Settings().placewise_home / "objects", exclusive=False)
    assert list(store.list("")) == []
    monkeypatch.setattr(FolderStore, "read_range", lambda *_: b"all of it")
    assert refused(check_object_store, Settings()).code == "object_store_unfit"
    assert list(store.list("")) == []


def test_who_lives_is_known_and_who_was_killed_soon_is_not(deployed: Catalog) -> None:
    settings = Settings()
    assert refused(check_processes, settings, "extractor").code == "nobody_there"
    with process_heartbeat(deployed, "extractor"):
        deadline = time.monotonic() + 30
        while True:
            with deployed.read() as session:
                if list_processes(session):
                    break
            assert time.monotonic() < deadline, "it gave no sign"
            time.sleep(0.01)
        assert check_processes(settings, "extractor").startswith("1 of release ")
        with deployed.write() as session:
            session.execute(update(RegisteredProcess).values(seen_at=db_now_plus(-60)))
        gone = refused(check_processes, settings, "extractor")
        assert re.search(r"The last heartbeat was \d+ s ago", gone.detail)
    with deployed.read() as session:
        assert list_processes(session) == [], "it has signed off"


def test_stored_photos_that_can_not_be_searched_for_are_named(deployed: Catalog) -> None:
    assert "no photo is left out" in _check_photos(Settings())
    with deployed.write() as session:
        map_id = add_map(session, "quay").id
        photo = add_photo(session, map_id)
        photo.job_id = add_job(session, map_id, photo_id=photo.id, state=JobState.FAILED).id
    error = refused(_check_photos, Settings())
    assert error.code == "photos_failed"
    assert "1 in the map quay" in error.detail


def test_a_steward_that_lives_and_frees_no_lease_is_found_out(deployed: Catalog) -> None:
    with deployed.write() as session:
        session.add(RegisteredProcess(role="steward", name="one", release="1"))
        add_job(session, add_map(session).id)
    assert "no overdue leases" in check_steward(Settings())
    job = take(deployed, 1)[0]
    set_columns(deployed, job.id, lease_until=db_now_plus(-60))
    assert refused(check_steward, Settings()).code == "leases_overdue"


def test_every_shard_has_to_be_answered_for(
    deployed: Catalog, store: FolderStore, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert refused(check_search, settings).code == "search_missing"
    first = SearchServer(deployed, store, settings, Shard(0, 2))
    second = SearchServer(deployed, store, settings, Shard(1, 2))
    try:
        monkeypatch.setenv("SEARCH_URLS", f"{first.url},{second.url}")
        assert check_search(Settings()).startswith("2 shards, 2 workers, 0 rows")
        second.stop()
        ill = refused(check_search, Settings())
        assert ill.code == "search_ill"
        assert "no worker serves shard 1/2" in ill.detail
    finally:
        first.stop()
        second.stop()


def test_a_gateway_that_is_not_there_is_named() -> None:
    gone = refused(check_gateway, "http://127.0.0.1:1", None)
    assert isinstance(gone, Unavailable)
    assert not isinstance(gone, Misconfigured)
    assert "http://127.0.0.1:1 does not answer" in gone.detail
