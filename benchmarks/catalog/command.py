"""Command `placewise bench catalog`: makes every catalog call of the services and explains it."""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any
from uuid import UUID

import psycopg
import typer
from PIL import Image
from psycopg.sql import SQL, Identifier
from rich.table import Table
from sqlalchemy import select
from sqlalchemy.engine import URL, make_url
from starlette.testclient import TestClient

from benchmarks.catalog.explain import Explainer
from benchmarks.catalog.fill import LARGEST_MAP, SyntheticCatalog, fill_catalog
from services.cli.environment import read_settings
from services.cli.output import JsonOption, console, err_console, print_json, report_errors
from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from services.search.catalog_sync import read_generation_versions
from services.steward.evaluation_search import read_geotagged_photos
from services.steward.scheduler import Scheduler
from shared.catalog.chunks import Descriptor, list_live_chunks, list_live_filter_values
from shared.catalog.jobs import STEWARD_JOBS
from shared.catalog.photos import Photo, PhotoRole, list_photos_changed_since
from shared.catalog.processes import upsert_search_worker
from shared.catalog.schema import migrate
from shared.catalog.session import Catalog, PoolConfig, TransactionTimeouts
from shared.config.settings import Settings
from shared.config.shards import SINGLE_SHARD
from shared.errors import Misconfigured, PlacewiseError
from shared.ids import new_id
from shared.jobs import InProcessWakeups, Job, JobState, claim_jobs, extend_lease, mark_started
from shared.jobs.leases import lock_leased_jobs
from shared.jobs.transitions import release_job
from shared.search_api.protocol import SearchHit, SearchRequest, SearchResponse, SearchStatus
from shared.storage import FolderStore

# They read a whole map, and that is known: a count every so often, an evaluation, and parts of file
# names that are too short for an index.
KNOWN_FULL_SCANS = (
    "steward: count large maps",
    "evaluation: located photos",
    "GET /search?filename=zq",
)


class FakeSearch:
    """Search client that returns the same photos for each query: only the catalog join counts."""

    def __init__(self, photo_ids: list[UUID]) -> None:
        self._hits = tuple(SearchHit(photo_id=photo_id, score=0.5) for photo_id in photo_ids)

    def search(self, request: SearchRequest) -> SearchResponse:
        return SearchResponse(
            hits=self._hits[: request.k],
            certificate="exhaustive",
            rows_scanned=0,
            rows_reranked=0,
            snapshot_version=request.min_version,
            missing=(),
        )

    def status(self) -> SearchStatus:
        return SearchStatus(shard="0/1", rows=0, resident_bytes=0, versions={}, missing=())


def run_all_calls(
    catalog: Catalog, filled: SyntheticCatalog, explainer: Explainer, folder: Path
) -> Iterator[str]:
    """Make every call once on the largest map; yields the name of each call before it is made."""
    for name, do in _all_calls(catalog, filled, folder):
        yield name
        with explainer.call(name):
            do()


def _all_calls(
    catalog: Catalog, filled: SyntheticCatalog, folder: Path
) -> Iterator[tuple[str, Callable[[], object]]]:
    settings = Settings(_env_file=None).model_copy(update={"auto_evaluate_photos": 20})
    store = FolderStore(folder / "objects")
    with catalog.read() as session:
        described = session.scalars(
            select(Descriptor.photo_id)
            .where(Descriptor.generation_id == filled.generation)
            .order_by(Descriptor.photo_id)
            .limit(200)
        ).all()
    ids = list(described)
    client = TestClient(
        create_app(
            GatewayContext(
                catalog,
                store,
                InProcessWakeups(),
                FakeSearch(ids),
                settings,
                LocalhostAuthenticator(),
            )
        ),
        base_url="http://localhost",
    )
    steward = Scheduler(catalog, store, InProcessWakeups(), settings)
    # First, because requests read what it has counted; so does it, wherever it has run before.
    for duty in sorted(steward.tasks, key=lambda duty: duty.name != "count large maps"):
        yield f"steward: {duty.name}", duty.run
    yield from _gateway_requests(client, catalog, filled, ids)
    yield from _extractor_calls(catalog)
    yield from _search_calls(catalog, filled)


def _gateway_requests(
    client: TestClient, catalog: Catalog, filled: SyntheticCatalog, ids: list[UUID]
) -> Iterator[tuple[str, Callable[[], object]]]:
    with catalog.read() as session:
        photo = session.get_one(Photo, ids[50])
        jobs = {
            state: session.scalars(
                select(Job.id).where(Job.map_id == filled.big, Job.state == state).limit(1)
            ).one()
            for state in (JobState.QUEUED, JobState.FAILED)
        }
    days_ago = {n: (datetime.now(UTC) - timedelta(days=n)).isoformat() for n in (1, 29)}
    near = f"{photo.latitude},{photo.longitude}"

    def ask(method: str, path: str, **options: Any) -> tuple[str, Callable[[], object]]:
        own_params = options.pop("params", {})
        params = own_params if path.startswith("/maps") else {"map": LARGEST_MAP, **own_params}
        query = "&".join(f"{name}={str(value)[:40]}" for name, value in own_params.items())
        label = f"{method} {_path_template(path)}{'?' if query else ''}{query}"

        def call() -> None:
            answer = client.request(method, f"/api/v1{path}", params=params, **options)
            if answer.status_code >= 400:
                raise PlacewiseError("bad_answer", f"{label}: {answer.text}")

        return label, call

    for found in (
        {},
        {"limit": 1000},
        {"filename": photo.filename[6:14]},
        {"filename": "street-"},
        {"filename": "no-such-photo"},
        {"filename": "zq"},
        {"upload_after": days_ago[1]},
        {"upload_before": days_ago[29]},
        {"min_file_size": 3_199_000},
        {"min_file_size": 1_000_000, "max_file_size": 1_000_500},
        {"near": f"{near},50"},
        {"near": f"{near},2000"},
        {"near": f"{near},200000"},
        {"box": "45.05,7.65,45.051,7.651"},
        {"box": "44,7,46,8"},
        {"place": "place-100"},
        {"tags": "night"},
        {"tags": "tag-100"},
        {"tags": "night,tag-100"},
        {"captured_after": days_ago[1]},
        {"captured_before": days_ago[29]},
        {"ids": ",".join(str(i) for i in ids[:100])},
        {"role": "query"},
        {"place": "place-100", "tags": "night", "near": f"{near},2000"},
    ):
        yield ask("GET", "/search", params=found)
    one = f"/uploads/{photo.id}"
    for path in ("/maps", f"/maps/{LARGEST_MAP}", "/database/stats", one, "/generations"):
        yield ask("GET", path)
    for found in (
        {},
        {"state": "failed"},
        {"state": "queued"},
        {"kind": "evaluate"},
        {"kind": "index", "state": "failed"},
        {"cursor": str(jobs[JobState.FAILED])},
    ):
        yield ask("GET", "/jobs", params=found)
    yield ask("GET", "/searches")
    yield ask("GET", "/evaluations")
    yield ask("GET", "/vocabularies")
    yield ask("GET", f"/jobs/{jobs[JobState.QUEUED]}")
    yield ask("POST", f"/jobs/{jobs[JobState.QUEUED]}/cancel")
    yield ask("POST", f"/jobs/{jobs[JobState.FAILED]}/retry")
    yield ask("POST", f"/similarity/{photo.id}", params={"top_k": 10})
    yield ask("PATCH", one, json={"place": "elsewhere"})
    yield ask("DELETE", f"/uploads/{ids[60]}")
    buffer = io.BytesIO()
    Image.new("RGB", (64, 48), "gray").save(buffer, "JPEG")
    yield ask("POST", "/upload", files={"file": ("a.jpg", buffer.getvalue())})
    yield ask("POST", "/evaluations", json={})


def _extractor_calls(catalog: Catalog) -> Iterator[tuple[str, Callable[[], object]]]:
    claimed: list[Job] = []

    def take() -> None:
        with catalog.write() as session:
            claimed[:] = claim_jobs(
                session, worker="bench", limit=16, lease_seconds=60, started=False
            )

    def keep() -> None:
        token = claimed[0].lease_token
        assert token is not None
        with catalog.write() as session:
            mark_started(session, token, len(claimed))
            extend_lease(session, token, 60)

    def give_back() -> None:
        token = claimed[0].lease_token
        assert token is not None
        with catalog.write() as session:
            for job in lock_leased_jobs(session, token, claimed):
                release_job(job)

    def take_queries() -> None:
        with catalog.write() as session:
            claim_jobs(session, worker="bench", limit=16, lease_seconds=60, min_priority=100)

    def take_evaluations() -> None:
        with catalog.write() as session:
            claim_jobs(session, worker="bench", limit=1, lease_seconds=60, kinds=STEWARD_JOBS)

    yield "extractor: claim a batch", take
    yield "extractor: hold the lease", keep
    yield "extractor: give back", give_back
    yield "extractor: claim queries", take_queries
    yield "evaluator: claim", take_evaluations


def _search_calls(
    catalog: Catalog, filled: SyntheticCatalog
) -> Iterator[tuple[str, Callable[[], object]]]:
    def follow() -> None:
        versions = read_generation_versions(catalog)
        assert filled.generation in versions
        with catalog.read() as session:
            chunks = list_live_chunks(session, filled.generation)
            list_live_filter_values(session, chunks[0].id)
            list_photos_changed_since(session, filled.big, filled.photos - 100)

    def tell() -> None:
        with catalog.write() as session:
            upsert_search_worker(session, new_id(), "bench", None, SINGLE_SHARD, {})

    def evaluate() -> None:
        with catalog.read() as session:
            read_geotagged_photos(session, filled.big, filled.generation, PhotoRole.QUERY)
            read_geotagged_photos(session, filled.big, filled.generation, PhotoRole.DATABASE)

    yield "search: follow", follow
    yield "search: register", tell
    yield "evaluation: located photos", evaluate


def _path_template(path: str) -> str:
    return "/".join("{id}" if len(part) == 36 else part for part in path.split("/"))


def bench_catalog(
    photos: Annotated[
        int, typer.Option(min=100_000, help="Number of photos to create.")
    ] = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Fill a PostgreSQL database with photos and explain every statement that the services send.

    Uses a temporary database on the server of DATABASE_URL, which is dropped at the end. The exit
    code is 1 if a statement scans a large table sequentially or reads far more rows than it
    returns.
    """
    with report_errors(as_json):
        url = make_url(read_settings().catalog_url())
        if url.get_backend_name() != "postgresql":
            raise Misconfigured("postgres_missing", "Set DATABASE_URL to a PostgreSQL to fill.")
        with _create_database(url) as own, tempfile.TemporaryDirectory() as folder:
            catalog = Catalog(
                own, PoolConfig(name="placewise-bench"), TransactionTimeouts(3600, 3600)
            )
            try:
                migrate(catalog)
                started = time.perf_counter()
                filled = fill_catalog(catalog, photos)
                err_console.print(
                    f"{photos:,} photos made in {time.perf_counter() - started:.0f} s"
                )
                explainer = Explainer(catalog)
                for name in run_all_calls(catalog, filled, explainer, Path(folder)):
                    err_console.print(f"  {name}", soft_wrap=True)
            finally:
                catalog.close()
    faulty = [e for e in explainer.found if e.faults() and e.call not in KNOWN_FULL_SCANS]
    if as_json:
        statements = [{**asdict(e), "faults": e.faults()} for e in explainer.found]
        print_json({"photos": photos, "tables": filled.tables, "statements": statements})
    else:
        table = Table("call", "ms", "read", "returned", "scans")
        for e in explainer.found:
            style = "red" if e in faulty else None
            table.add_row(
                e.call,
                f"{e.milliseconds:.1f}",
                f"{e.read:,}",
                f"{e.returned:,}",
                ", ".join(e.scans),
                style=style,
            )
        console.print(table)
        for name, size_bytes in sorted(filled.tables.items(), key=lambda item: -item[1]):
            console.print(f"{name}: {size_bytes / photos:,.0f} bytes per photo")
        for e in faulty:
            console.print(f"[red]{e.call}[/red]: {'; '.join(e.faults())}\n  {e.sql}")
    if faulty:
        raise typer.Exit(1)


@contextlib.contextmanager
def _create_database(url: URL) -> Iterator[str]:
    """Create a database on the same server and return its URL."""
    name = f"placewise_bench_{new_id().hex}"
    admin = url.set(drivername="postgresql").render_as_string(hide_password=False)
    with psycopg.connect(admin, autocommit=True) as connection:
        connection.execute(SQL("CREATE DATABASE {}").format(Identifier(name)))
    try:
        yield url.set(database=name).render_as_string(hide_password=False)
    finally:
        with psycopg.connect(admin, autocommit=True) as connection:
            connection.execute(SQL("DROP DATABASE {} WITH (FORCE)").format(Identifier(name)))
