"""Migrations beside a running fleet: traffic goes on, and a release knows its own schema."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any
from uuid import UUID

import pytest
from alembic import command
from alembic.config import Config
from sqlalchemy import MetaData, Table, func, make_url, select, text

from shared.catalog.chunks import Chunk
from shared.catalog.database import schema
from shared.catalog.database.base import db_now
from shared.catalog.database.schema import check_schema, migrate, wait_for_schema
from shared.catalog.database.session import Catalog, PoolConfig, TransactionTimeouts
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.catalog.vocabularies import VocabularyOrigin, add_vocabulary
from shared.errors import Misconfigured, Unavailable
from shared.ids import new_id
from tests.support.catalog_rows import add_generation, add_map, made_up_photo
from tests.support.servers import PostgresServer


@pytest.fixture
def catalog(postgres: PostgresServer) -> Iterator[Catalog]:
    opened = Catalog(postgres.new_database(), PoolConfig(), TransactionTimeouts(5, 3))
    yield opened
    opened.close()


def migrate_to(catalog: Catalog, revision: str) -> None:
    """As an earlier release would have left it."""
    config = Config()
    config.set_main_option("script_location", str(schema.MIGRATIONS))
    with catalog.engine.connect() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, revision)


def of_its_release(catalog: Catalog, name: str) -> Table:
    """The table as a process knows it that was started at the catalog's present revision."""
    return Table(name, MetaData(), autoload_with=catalog.engine, resolve_fks=False)


def test_migration_under_uploads_loses_none_and_fails_none(catalog: Catalog) -> None:
    migrate_to(catalog, "0006")
    photos = of_its_release(catalog, "photos")
    assert set(photos.columns.keys()) < set(Photo.__table__.columns.keys()), "of an older release"
    with catalog.write() as session:
        map_id = new_id()
        values = {"id": map_id, "name": "default", "extractor": "test-tiny-avg", "version": 0}
        maps = of_its_release(catalog, "maps")
        session.execute(maps.insert().values(**values, created_at=db_now()))
    stored: list[UUID] = []
    failed: list[Exception] = []
    stop = threading.Event()

    def upload() -> None:
        while not stop.is_set():
            try:
                photo = made_up_photo(
                    map_id, tags=[], metadata={}, uploaded_at=db_now(), changed_version=0
                )
                with catalog.write() as session:
                    session.execute(photos.insert().values(photo))
                stored.append(photo["id"])
            except Exception as error:
                failed.append(error)
                return

    uploaders = [threading.Thread(target=upload) for _ in range(3)]
    for uploader in uploaders:
        uploader.start()
    while len(stored) < 100:
        time.sleep(0.01)
    before = len(stored)
    migrate(catalog)
    during = len(stored) - before
    stop.set()
    for uploader in uploaders:
        uploader.join()
    assert not failed
    assert during > 0, "uploads stood still meanwhile"
    check_schema(catalog)
    with catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(Photo)) == len(stored)


@pytest.mark.parametrize(
    ("origin", "auto_fit", "fitted_photos"),
    [("fitted", True, 7), ("imported", False, None), ("shipped", True, None)],
)
def test_an_existing_map_keeps_its_vocabulary_unless_it_is_foreign(
    catalog: Catalog, origin: str, auto_fit: bool, fitted_photos: int | None
) -> None:
    migrate(catalog)
    with catalog.write() as session:
        map_id = add_map(session, extractor="test-tiny-vlad").id
        vocabulary = add_vocabulary(
            session,
            map_id,
            VocabularyOrigin(origin),
            shape=(8, 16),
            object_key="vocabulary",
            sha256="0" * 64,
            provenance={},
        )
        generation = add_generation(session, map_id, vocabulary_id=vocabulary.id)
        columns = {"slot": 0, "object_key": "chunk", "size_bytes": 1, "sha256": "0" * 64}
        session.add(Chunk(generation_id=generation.id, rows=7, **columns))
    with catalog.engine.begin() as connection:
        connection.exec_driver_sql(
            "ALTER TABLE maps DROP COLUMN auto_fit, DROP COLUMN fitted_photos, "
            "DROP COLUMN place_labels_are_automatic"
        )
        connection.exec_driver_sql("ALTER TABLE searches DROP COLUMN has_place")
        connection.exec_driver_sql("DROP INDEX ix_photos_relative_path")
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '0026'")
    migrate(catalog)
    with catalog.read() as session:
        map_ = session.get_one(Map, map_id)
        assert (map_.auto_fit, map_.fitted_photos) == (auto_fit, fitted_photos)


def test_migration_gives_way_to_a_lock_and_is_tried_again(catalog: Catalog) -> None:
    migrate_to(catalog, "0005")
    done = threading.Event()

    def run() -> None:
        migrate(catalog)
        done.set()

    with catalog.write() as session:
        # 0006 refers to maps, which takes a lock that this one keeps out.
        session.execute(text("LOCK TABLE maps IN ROW EXCLUSIVE MODE"))
        migrating = threading.Thread(target=run)
        migrating.start()
        assert not done.wait(2.5), "longer than it waits for a lock"
    migrating.join(timeout=60)
    assert done.is_set()
    check_schema(catalog)


def test_lock_that_is_never_free_ends_the_migration(catalog: Catalog) -> None:
    with catalog.engine.begin() as connection:
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({schema.ADVISORY_LOCK_ID})")
        with pytest.raises(Unavailable, match="Another migration"):
            migrate(catalog, timeout_seconds=0.2)


def test_broken_off_index_is_built_anew(catalog: Catalog) -> None:
    migrate_to(catalog, "0006")
    with catalog.engine.begin() as connection:
        connection.exec_driver_sql("CREATE INDEX ix_photos_map_size ON photos (map_id)")
        connection.exec_driver_sql(
            "UPDATE pg_index SET indisvalid = false"
            " WHERE indexrelid = 'ix_photos_map_size'::regclass"
        )
    migrate(catalog)
    with catalog.read() as session:
        made = session.scalar(
            text("SELECT indexdef FROM pg_indexes WHERE indexname = 'ix_photos_map_size'")
        )
    assert "size_bytes" in made


def test_service_waits_for_the_migration_and_then_starts(catalog: Catalog) -> None:
    with pytest.raises(Misconfigured, match="placewise migrate") as caught:
        wait_for_schema(catalog, 0.1)
    assert caught.value.code == "schema_outdated"
    waiting = threading.Thread(target=wait_for_schema, args=(catalog, 60))
    waiting.start()
    migrate(catalog)
    waiting.join(timeout=30)
    assert not waiting.is_alive()


def test_schema_of_a_later_release_is_fine_until_it_is_no_longer_understood(
    catalog: Catalog,
) -> None:
    migrate(catalog)
    with catalog.engine.begin() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9998'")
    check_schema(catalog)
    with catalog.engine.begin() as connection:
        connection.exec_driver_sql("UPDATE schema_compatibility SET understood_from = '9998'")
    with pytest.raises(Misconfigured) as caught:
        wait_for_schema(catalog, 60)
    assert caught.value.code == "schema_too_new"


@pytest.mark.parametrize(
    ("address", "named"),
    [
        ("nobody@127.0.0.1:1/none", "database none at 127.0.0.1:1"),
        ("/none?host=/nowhere", "database none at /nowhere"),
    ],
)
def test_catalog_that_is_away_is_waited_for(address: str, named: str) -> None:
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
