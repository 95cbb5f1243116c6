"""Errors of a catalog that is damaged, full or no catalog, at the start and at run time."""

from __future__ import annotations

import logging
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import event, inspect, text
from sqlalchemy.dialects.postgresql.base import PGDialect
from sqlalchemy.exc import OperationalError
from starlette.testclient import TestClient

from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from services.search.worker import SearchWorker
from shared.catalog.database.errors import to_unavailable
from shared.catalog.database.schema import check_pages, migrate
from shared.catalog.database.session import Catalog
from shared.catalog.maps import get_or_create_default_map
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.errors import Misconfigured, StorageFull
from shared.jobs import InProcessWakeups
from shared.storage import FolderStore
from tests.support.problems import problem
from tests.support.server import environment, run_command
from tests.support.servers import PostgresServer

PAGE_BYTES = 4096


@pytest.fixture
def file(migrated_sqlite: Path, tmp_path: Path) -> Path:
    """A migrated catalog, as a server leaves it behind."""
    home = tmp_path / "home"
    home.mkdir()
    return Path(shutil.copy(migrated_sqlite, home / "catalog.sqlite"))


@pytest.fixture
def catalog(file: Path) -> Iterator[Catalog]:
    opened = Catalog(f"sqlite:///{file}")
    yield opened
    opened.close()


def damage_pages(file: Path) -> None:
    """Every page but the first, which holds the schema's table of tables."""
    with file.open("r+b") as opened:
        opened.seek(PAGE_BYTES)
        opened.write(b"\xa5" * (file.stat().st_size - PAGE_BYTES))


def damage_last_page(file: Path) -> None:
    with file.open("r+b") as opened:
        opened.seek(-PAGE_BYTES, os.SEEK_END)
        opened.write(b"\xa5" * PAGE_BYTES)


def no_sqlite(file: Path) -> None:
    file.write_bytes(b"These are notes of someone, and no catalog at all. " * 100)


def truncate(file: Path) -> None:
    os.truncate(file, 3 * PAGE_BYTES)


def make_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


@pytest.mark.parametrize(
    ("damage", "code", "says"),
    [
        (damage_pages, "catalog_damaged", "placewise storage rebuild"),
        (damage_last_page, "catalog_damaged", "placewise storage restore FOLDER"),
        (truncate, "catalog_damaged", "placewise storage restore FOLDER"),
        (no_sqlite, "catalog_damaged", "file is not a database"),
        (make_folder, "catalog_is_folder", "is a folder"),
    ],
)
def test_an_unusable_catalog_is_reported_with_its_file_and_remedies(
    file: Path, catalog: Catalog, damage: Callable[[Path], None], code: str, says: str
) -> None:
    damage(file)
    with pytest.raises(Misconfigured) as caught:
        migrate(catalog)
    assert caught.value.code == code
    assert str(file) in caught.value.detail
    assert says in caught.value.detail


def test_a_file_that_may_not_be_written_is_named(
    file: Path, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its permissions are not changed: to root they mean nothing."""
    monkeypatch.setattr("shared.catalog.database.schema.os.access", lambda path, mode: False)
    with pytest.raises(Misconfigured, match="permissions") as caught:
        migrate(catalog)
    assert (caught.value.code, str(file) in caught.value.detail) == ("catalog_unreadable", True)


def test_a_large_catalog_is_read_whole_by_the_doctor_only(file: Path, catalog: Catalog) -> None:
    damage_last_page(file)
    check_pages(catalog, max_bytes=PAGE_BYTES)
    with pytest.raises(Misconfigured, match="placewise storage restore"):
        check_pages(catalog, max_bytes=None)


def test_a_postgresql_that_is_too_old_is_refused_before_anything_is_created(
    postgres: PostgresServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalog = Catalog(postgres.new_database())
    with monkeypatch.context() as context:
        context.setattr(PGDialect, "_get_server_version_info", lambda *_: (13, 4))
        with pytest.raises(
            Misconfigured, match=r"PostgreSQL 13\.4 is too old. Upgrade to 14"
        ) as old:
            migrate(catalog)
    assert old.value.code == "postgres_too_old"
    with catalog.read() as session:
        assert inspect(session.connection()).get_table_names() == []
    catalog.close()


def test_an_sqlite_that_is_too_old_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sqlite3, "sqlite_version_info", (3, 34, 1))  # of Red Hat Enterprise Linux 9
    with pytest.raises(Misconfigured, match=r"3\.35 or newer is required"):
        migrate(Catalog(f"sqlite:///{tmp_path / 'catalog.sqlite'}"))


@pytest.mark.parametrize("command", ["serve", "doctor"])
def test_a_command_on_a_damaged_catalog_ends_with_a_sentence(file: Path, command: str) -> None:
    no_sqlite(file)
    done = run_command(command, env=environment(file.parent), cwd=file.parent)
    output = done.stdout + done.stderr
    assert done.returncode == 1
    assert str(file) in output
    assert "placewise storage rebuild" in output
    assert "Traceback" not in output


# --- while it runs ---------------------------------------------------------------------------


@pytest.fixture
def client(catalog: Catalog, store: FolderStore, settings: Settings) -> TestClient:
    with catalog.write() as session:
        get_or_create_default_map(session, settings.extractor)
    search = SearchWorker(catalog, store, settings)
    gateway = GatewayContext(
        catalog, store, InProcessWakeups(), search, settings, LocalhostAuthenticator()
    )
    return TestClient(create_app(gateway), base_url="http://localhost")


def test_damage_that_is_met_at_run_time_is_a_503_with_one_line_in_the_log(
    catalog: Catalog, file: Path, client: TestClient, caplog: pytest.LogCaptureFixture
) -> None:
    catalog.close()  # its last connection writes the log back into the file
    damage_pages(file)
    with caplog.at_level(logging.INFO):
        problem(client.get("/api/v1/maps"), 503, "catalog_damaged")
    errors = [record for record in caplog.records if record.levelno >= logging.ERROR]
    assert [record.exc_info for record in errors] == [None]
    health = client.get("/api/v1/health")
    assert health.status_code == 503
    part = health.json()["parts"]["catalog"]
    assert part["status"] == "unhealthy"
    assert "doctor" in part["detail"]


def test_a_catalog_without_room_is_a_507(catalog: Catalog, client: TestClient) -> None:
    def limit(connection: sqlite3.Connection, *_: object) -> None:
        connection.execute("PRAGMA max_page_count = 1")  # as it is now, and not a page more

    catalog.close()
    event.listen(catalog.engine, "connect", limit)
    for number in range(200):
        answer = client.post("/api/v1/maps", json={"name": f"a-map-with-a-long-name-{number:060}"})
        if answer.status_code != 201:
            break
    problem(answer, 507, "disk_full")
    assert int(answer.headers["retry-after"]) > 0
    assert client.get("/api/v1/maps").status_code == 200


def test_a_failing_disk_and_a_postgresql_without_room_are_no_outages() -> None:
    original = sqlite3.OperationalError("disk I/O error")
    original.sqlite_errorname = "SQLITE_IOERR_READ"
    error = to_unavailable(OperationalError("SELECT 1", {}, original))
    assert error is not None
    assert (error.code, error.status) == ("catalog_io_error", 503)
    assert "dmesg" in error.detail

    class DiskFull(Exception):
        sqlstate = "53100"

    error = to_unavailable(OperationalError("INSERT", {}, DiskFull("no space left on device")))
    assert isinstance(error, StorageFull)


def test_a_full_disk_at_the_start_is_reported_with_the_free_bytes(
    file: Path, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        original = sqlite3.OperationalError("disk I/O error")
        original.sqlite_errorname = "SQLITE_IOERR_SHMSIZE"  # as SQLite says on a full tmpfs
        raise OperationalError("PRAGMA journal_mode = WAL", {}, original)

    event.listen(catalog.engine, "begin", full)
    usage = shutil._ntuple_diskusage(100, 100, 0)
    monkeypatch.setattr("shared.catalog.database.schema.shutil.disk_usage", lambda folder: usage)
    with pytest.raises(Misconfigured, match="Free space") as caught:
        migrate(catalog)
    assert caught.value.code == "disk_full"
    with catalog.engine.connect() as connection, pytest.raises(OperationalError):
        connection.execute(text("SELECT 1"))


@pytest.mark.parametrize("rest", ["me:s3cret@db:port/x", "me:s3cret@[::db/x", "me:s3cret/x:y@z:/"])
def test_a_malformed_url_is_a_bad_setting_without_its_password(
    monkeypatch: pytest.MonkeyPatch, rest: str
) -> None:
    monkeypatch.setenv("DATABASE_URL", f"postgresql://{rest}")
    with pytest.raises(Misconfigured, match="DATABASE_URL is malformed") as caught:
        open_catalog(Settings(), "test")
    assert caught.value.code == "bad_setting"
    assert "s3cret" not in caught.value.detail
    assert caught.value.__suppress_context__
