"""Fixtures and markers of all tests. docs/CONTRIBUTING.md says what belongs where."""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import shutil
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

# Before NumPy and PyTorch are imported. Tests and the processes that they start share few cores:
# more threads than one in each would wait for each other, which costs a quarter of the CPU time.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import execnet
import hypothesis
import pytest
from sqlalchemy.engine import make_url

from services.cli import collection_paused
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.storage import FolderStore
from tests.support.compiled_statements import share_compiled_statements
from tests.support.processes import forked_command
from tests.support.servers import (
    PostgresServer,
    RedisServer,
    S3Server,
    start_moto,
    start_postgres,
    start_redis,
    start_s3,
)
from tests.support.shared_tls import share_tls_context
from tests.support.spare_databases import SpareDatabases

FORKED_WORKERS = pytest.StashKey[bool]()
REAL_PHOTOS = "PLACEWISE_TEST_DATA"
BROWSER = "PLACEWISE_TEST_BROWSER"
IMAGES = "PLACEWISE_TEST_IMAGES"
CHAOS = "PLACEWISE_TEST_CHAOS"
SERVER_FIXTURES = frozenset({"postgres", "redis", "s3", "moto"})
SERVER_PARAMETERS = frozenset({"postgresql", "redis", "s3", "moto", "bucket"})
TESTS = Path(__file__).parent
# The kinds with the longest files first: a long file that starts last runs alone.
WAITING = ("faults", "deploy", "e2e", "browser")  # for other processes
COMPUTING = ("integration", "contract", "unit")
# A test makes many objects and little garbage: collecting at Python's 700 objects takes a tenth of
# the CPU time of tests of the gateway.
gc.set_threshold(50_000)
share_compiled_statements()
share_tls_context()
hypothesis.settings.register_profile("any processor", deadline=None)
hypothesis.settings.load_profile("any processor")
# Imports freeze their objects, of which triton would report hundreds as leaked at the end.
atexit.register(gc.unfreeze)
# A variable, the paths that are collected where it is set, and what to say where it is not.
OPTIONAL: tuple[tuple[str, list[str], str], ...] = (
    (REAL_PHOTOS, [], f"on real photos: {REAL_PHOTOS}=FOLDER runs them (docs/CONTRIBUTING.md)"),
    (BROWSER, ["browser"], "in a browser: make test-browser runs them"),
    (IMAGES, ["deploy/images"], "of the images: make test-images runs them"),
    (
        CHAOS,
        ["faults/test_chaos.py", "faults/test_milvus.py", "faults/test_rolling.py"],
        "of a deployment or a Milvus under faults: make test-chaos runs them",
    ),
)
LEFT_OUT = [option for option in OPTIONAL if not os.environ.get(option[0])]
collect_ignore = [path for _, paths, _ in LEFT_OUT for path in paths]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """`auto` is one more than there are cores, because some test always waits; `logical` is one
    for each core."""
    waiting = config.getoption("numprocesses") == "auto"
    config.option.testrunuid = str(os.getpid())  # by which the workers find the fork server
    config.stash[FORKED_WORKERS] = sys.platform == "linux"
    return (os.cpu_count() or 1) + int(waiting)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config, specs: list[execnet.XSpec]) -> None:
    """Fork the workers of `auto` and `logical` from the process that has imported everything:
    each would need 13 CPU seconds for it."""
    if config.stash.get(FORKED_WORKERS, False):
        for spec in specs:
            spec.python = forked_command(TESTS / "support" / "forked_worker.py")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Import the test modules without garbage collection: a third of the time that it takes."""
    with collection_paused():
        return (yield)


@pytest.hookimpl(tryfirst=True)  # before `-m` reads the markers
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mix files that wait with files that compute, and mark tests that need a server.

    Tests on real photos are deselected unless they are enabled.
    """
    places = {**_places(items, WAITING), **_places(items, COMPUTING)}
    items.sort(key=lambda item: places[item.path])
    selected: list[pytest.Item] = []
    deselected: list[pytest.Item] = []
    for item in items:
        if _needs_server(item):
            item.add_marker("servers")
        disabled = item.get_closest_marker("real_photos") and not os.environ.get(REAL_PHOTOS)
        (deselected if disabled else selected).append(item)
    if deselected:
        config.hook.pytest_deselected(items=deselected)
        items[:] = selected


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test of the catalog on both databases, a test of `integration` on SQLite, or on those
    that its nearest marker names."""
    if "catalog_kind" in metafunc.fixturenames:
        marker = metafunc.definition.get_closest_marker("databases")
        integration = _kind(metafunc.definition.path) == "integration"
        default = ("sqlite",) if integration else ("sqlite", "postgresql")
        metafunc.parametrize("catalog_kind", marker.args if marker else default)


def _places(items: list[pytest.Item], kinds: tuple[str, ...]) -> dict[Path, float]:
    """The relative position of each file among those of these kinds, from 0 to 1."""
    paths = dict.fromkeys(item.path for item in items)
    files = {path: kinds.index(_kind(path)) for path in paths if _kind(path) in kinds}
    ordered = sorted(files, key=files.__getitem__)
    return {file: place / len(ordered) for place, file in enumerate(ordered)}


def _needs_server(item: pytest.Item) -> bool:
    """Whether a fixture or parameter of the test starts PostgreSQL, Redis or an S3 server."""
    fixtures = set(getattr(item, "fixturenames", ()))
    callspec = getattr(item, "callspec", None)
    parameters = set() if callspec is None else {str(value) for value in callspec.params.values()}
    return bool(fixtures & SERVER_FIXTURES or parameters & SERVER_PARAMETERS)


def _kind(path: Path) -> str:
    kind, below, *_ = path.relative_to(TESTS).parts
    return below if kind == "lab" else kind


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for _, _, which in LEFT_OUT:
        terminalreporter.write_line(f"Left out are the tests {which}.")


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


@pytest.fixture(scope="session")
def redis() -> Iterator[RedisServer]:
    """A real Redis, as above."""
    with start_redis() as server:
        yield server


@pytest.fixture(scope="session")
def s3() -> Iterator[S3Server]:
    """A real S3 server, as above."""
    with start_s3() as server:
        yield server


@pytest.fixture(scope="session")
def moto() -> Iterator[S3Server]:
    """A bucket that takes whatever is sent: what is signed protects nothing there."""
    with start_moto() as server:
        yield server


@pytest.fixture(scope="session")
def migrated_sqlite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A migrated catalog to copy: a migration for each test would take most of its time."""
    path = tmp_path_factory.mktemp("template") / "catalog.sqlite"
    _migrate(f"sqlite:///{path}")
    return path


@pytest.fixture(scope="session")
def migrated_postgres(postgres: PostgresServer) -> str:
    """The name of a migrated database to copy."""
    url = postgres.new_database()
    _migrate(url)
    return str(make_url(url).database)


def _migrate(url: str) -> None:
    catalog = Catalog(url)
    migrate(catalog)
    catalog.close()


@pytest.fixture(scope="session")
def spare_databases(postgres: PostgresServer, migrated_postgres: str) -> SpareDatabases:
    return SpareDatabases(postgres, migrated_postgres)


@pytest.fixture
def catalog(catalog_kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Catalog]:
    """An empty, migrated catalog: each test that takes it runs on the databases of its marker."""
    with contextlib.ExitStack() as stack:
        if catalog_kind == "sqlite":
            copy = shutil.copy(request.getfixturevalue("migrated_sqlite"), tmp_path)
            url = f"sqlite:///{copy}"
        else:
            spare: SpareDatabases = request.getfixturevalue("spare_databases")
            url = stack.enter_context(spare.one())
        yield stack.enter_context(contextlib.closing(Catalog(url)))


@pytest.fixture
def store(tmp_path: Path) -> FolderStore:
    return FolderStore(tmp_path / "objects")


@pytest.fixture
def settings() -> Settings:
    """Settings as the test's environment has them: the tiny extractor, a temporary home."""
    return Settings()
