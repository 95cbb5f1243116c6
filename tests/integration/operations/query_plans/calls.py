"""Makes every catalog call of the services on a filled database, and explains its statements."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import UUID

from PIL import Image
from sqlalchemy import select
from starlette.testclient import TestClient

from services.gateway.app import create_app
from services.gateway.authentication import LocalhostAuthenticator
from services.gateway.dependencies import GatewayContext
from services.search.catalog_sync import read_generation_versions
from services.steward.evaluation_search import read_geotagged_photos
from services.steward.scheduler import Scheduler
from shared.catalog.chunks import Descriptor, list_live_chunks, list_live_filter_values
from shared.catalog.database.session import Catalog
from shared.catalog.photos import Photo, PhotoRole, list_photos_changed_since
from shared.catalog.processes import upsert_process
from shared.config.settings import Settings
from shared.errors import PlacewiseError
from shared.ids import new_id
from shared.jobs import InProcessWakeups, Job, JobKind, JobState
from shared.jobs.claim import claim_jobs, mark_started
from shared.jobs.leases import extend_lease, lock_leased_jobs
from shared.jobs.transitions import requeue_job
from shared.search_api.protocol import (
    MatchRequest,
    MatchResponse,
    PoseRequest,
    PoseResponse,
    SearchHit,
    SearchRequest,
    SearchResponse,
    SearchStatus,
)
from shared.storage import FolderStore
from tests.integration.operations.query_plans.explain import Explainer
from tests.integration.operations.query_plans.fill import LARGEST_MAP, SyntheticCatalog

# Calls that may read a whole map: a periodic count, the hourly snapshot of the journal, an
# evaluation, and substrings of file names that are too short for an index.
KNOWN_FULL_SCANS = (
    "steward: write_snapshot",
    "steward: update_statistics_of_large_maps",
    "evaluation: located photos",
    "GET /search?filename=zq",
)


class _FakeSearch:
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

    def match(self, request: MatchRequest) -> MatchResponse:
        return MatchResponse(candidates=(None,) * len(request.candidates))

    def estimate_pose(self, request: PoseRequest) -> PoseResponse:
        return PoseResponse(reason="The query has too little texture to find points in it.")

    def status(self) -> SearchStatus:
        return SearchStatus(rows=0, resident_bytes=0, versions={}, missing=())


def run_all_calls(
    catalog: Catalog,
    filled: SyntheticCatalog,
    explainer: Explainer,
    folder: Path,
    name_part: str = "",
) -> Iterator[str]:
    """Make every call whose name contains `name_part` once on the largest map.

    Yields the name of each call before it is made.
    """
    for name, do in _all_calls(catalog, filled, folder):
        if name_part in name:
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
                _FakeSearch(ids),
                settings,
                LocalhostAuthenticator(),
            )
        ),
        base_url="http://localhost",
    )
    steward = Scheduler(catalog, store, InProcessWakeups(), settings)
    counts = "update_statistics_of_large_maps"  # first, because requests read them
    for task in sorted(steward.tasks, key=lambda task: task.name != counts):
        yield f"steward: {task.name}", task.run
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

    def request(method: str, path: str, **options: Any) -> tuple[str, Callable[[], object]]:
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
        yield request("GET", "/search", params=found)
    one = f"/uploads/{photo.id}"
    for path in ("/maps", f"/maps/{LARGEST_MAP}", "/database/stats", one, "/generations"):
        yield request("GET", path)
    for found in (
        {},
        {"state": "failed"},
        {"state": "queued"},
        {"kind": "evaluate"},
        {"kind": "index", "state": "failed"},
        {"cursor": str(jobs[JobState.FAILED])},
    ):
        yield request("GET", "/jobs", params=found)
    yield request("GET", "/searches")
    yield request("GET", "/evaluations")
    yield request("GET", "/vocabularies")
    yield request("GET", f"/jobs/{jobs[JobState.QUEUED]}")
    yield request("POST", f"/jobs/{jobs[JobState.QUEUED]}/cancel")
    yield request("POST", f"/jobs/{jobs[JobState.FAILED]}/retry")
    yield request("POST", f"/similarity/{photo.id}", params={"top_k": 10})
    yield request("POST", f"/similarity/{photo.id}", params={"pose": "true"})
    yield request("PATCH", one, json={"place": "elsewhere"})
    yield request("DELETE", f"/uploads/{ids[60]}")
    buffer = io.BytesIO()
    Image.new("RGB", (64, 48), "gray").save(buffer, "JPEG")
    yield request("POST", "/upload", files={"file": ("a.jpg", buffer.getvalue())})
    yield request("POST", "/evaluations", json={})


def _extractor_calls(catalog: Catalog) -> Iterator[tuple[str, Callable[[], object]]]:
    claimed: list[Job] = []

    def claim_batch() -> None:
        with catalog.write() as session:
            claimed[:] = claim_jobs(
                session, worker="explained", limit=16, lease_seconds=60, started=False
            )

    def extend() -> None:
        token = claimed[0].lease_token
        assert token is not None
        with catalog.write() as session:
            mark_started(session, token, len(claimed))
            extend_lease(session, token, 60)

    def release() -> None:
        token = claimed[0].lease_token
        assert token is not None
        with catalog.write() as session:
            for job in lock_leased_jobs(session, token, claimed):
                requeue_job(job)

    def claim_queries() -> None:
        with catalog.write() as session:
            claim_jobs(session, worker="explained", limit=16, lease_seconds=60, min_priority=100)

    def claim_evaluations() -> None:
        with catalog.write() as session:
            claim_jobs(
                session, worker="explained", limit=1, lease_seconds=60, kinds=[JobKind.EVALUATE]
            )

    yield "extractor: claim a batch", claim_batch
    yield "extractor: hold the lease", extend
    yield "extractor: give back", release
    yield "extractor: claim queries", claim_queries
    yield "evaluator: claim", claim_evaluations


def _search_calls(
    catalog: Catalog, filled: SyntheticCatalog
) -> Iterator[tuple[str, Callable[[], object]]]:
    def sync() -> None:
        versions = read_generation_versions(catalog)
        assert filled.generation in versions
        with catalog.read() as session:
            chunks = list_live_chunks(session, filled.generation)
            list_live_filter_values(session, chunks[0].id)
            list_photos_changed_since(session, filled.big, filled.photos - 100)

    def register() -> None:
        with catalog.write() as session:
            upsert_process(session, new_id(), "search", "explained", {"loaded": {}})

    def evaluate() -> None:
        with catalog.read() as session:
            read_geotagged_photos(session, filled.big, filled.generation, PhotoRole.QUERY)
            read_geotagged_photos(session, filled.big, filled.generation, PhotoRole.DATABASE)

    yield "search: follow", sync
    yield "search: register", register
    yield "evaluation: located photos", evaluate


def _path_template(path: str) -> str:
    return "/".join("{id}" if len(part) == 36 else part for part in path.split("/"))
