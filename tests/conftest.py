"""What every kind of test may use. See CONTRIBUTING in docs/ for what belongs where."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared.catalog.session import Catalog
from shared.objects import FolderStore
from shared.settings import Settings
from tests.support.postgres import PostgresServer, start_postgres

REAL_PHOTOS = "PLACEWISE_TEST_DATA"

# As the command does before torch is loaded; see services/cli/__init__.py.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Without the real photos, the tests that need them are deselected, and one line says so."""
    if os.environ.get(REAL_PHOTOS):
        return
    without = [item for item in items if item.get_closest_marker("real_photos")]
    if without:
        config.hook.pytest_deselected(items=without)
        items[:] = [item for item in items if item not in without]
        config.stash[DESELECTED] = len(without)


DESELECTED = pytest.StashKey[int]()


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    count = config.stash.get(DESELECTED, 0)
    if count:
        terminalreporter.write_line(
            f"{count} tests on real photos were left out: set {REAL_PHOTOS} to a folder with "
            "toy-places/ to run them"
        )


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No test sees the developer's settings, and none writes into the repository."""
    for name in Settings.model_fields:
        monkeypatch.delenv(name.upper(), raising=False)
    monkeypatch.setenv("PLACEWISE_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("ALLOW_TEST_EXTRACTORS", "true")
    monkeypatch.setenv("EXTRACTOR", "test-tiny-avg")
    monkeypatch.setitem(Settings.model_config, "env_file", None)


@pytest.fixture(scope="session")
def real_photos() -> Path:
    """The folder that PLACEWISE_TEST_DATA names."""
    return Path(os.environ[REAL_PHOTOS])


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    """A real PostgreSQL; the test fails, and says how to get one, where none can be started."""
    with start_postgres() as server:
        yield server


@pytest.fixture(params=["sqlite", "postgresql"])
def catalog(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Catalog]:
    """An empty, migrated catalog: each test that takes it runs on SQLite and on PostgreSQL."""
    if request.param == "sqlite":
        opened = Catalog(f"sqlite:///{tmp_path / 'catalog.sqlite'}")
    else:
        server: PostgresServer = request.getfixturevalue("postgres")
        opened = Catalog(server.new_database())
    opened.migrate()
    yield opened
    opened.close()


@pytest.fixture
def store(tmp_path: Path) -> FolderStore:
    return FolderStore(tmp_path / "objects")


@pytest.fixture
def settings() -> Settings:
    """Settings as the test's environment has them: the tiny extractor, a temporary home."""
    return Settings()
