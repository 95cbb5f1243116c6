"""Latency of queries by new photos while thousands of uploads wait to be described.

    placewise bench query-latency [--backlog 5000] [--seconds 60] [--milliseconds 50] [--batch 16]

A batch that runs on the model cannot be interrupted. A query may therefore wait for one batch, but
not for two. Reported: the time of a batch, and p50, p95 and maximum of a query.
"""

from __future__ import annotations

import contextlib
import itertools
import random
import statistics
import time
from collections.abc import Sequence
from datetime import datetime
from http.client import HTTPConnection
from typing import Annotated
from uuid import UUID

import typer
from sqlalchemy import func, insert, select

from lab.benchmarks.fleet import Fleet, open_fleet
from lab.benchmarks.invariants import count_unfinished_jobs
from lab.benchmarks.load_generator import (
    connect,
    make_jpegs,
    multipart_form,
    multipart_forms,
    post_form,
    upload_all,
    wait_for_jobs,
)
from lab.benchmarks.report import printed_report
from services.cli.output import JsonOption
from shared.catalog.chunks import Chunk
from shared.catalog.photos import Photo
from shared.ids import new_id
from shared.jobs import Job, JobKind, JobState, Priority
from tests.support.catalog_rows import made_up_photo

TARGET_MS_ABOVE_BATCH = 100.0
SIZE, SIZE_BYTES = (1024, 768), 100_000
DESCRIPTOR_DIMENSION = 7168
TEXTURES = 64  # distinct photos, so that few of the retrieved rows are equal
TIMEOUT_SECONDS = 120.0
SEED = 20_261_121


def bench(
    backlog: Annotated[int, typer.Option(min=1, help="Number of queued uploads.")] = 5000,
    seconds: Annotated[float, typer.Option(min=1, help="Duration of the measurement.")] = 60,
    milliseconds: Annotated[int, typer.Option(min=0, help="Simulated work per photo.")] = 50,
    batch: Annotated[int, typer.Option(min=1, help="Maximum batch size.")] = 16,
    as_json: JsonOption = False,
) -> None:
    """Measure query latency while thousands of uploads are queued."""
    photos = make_jpegs(TEXTURES, SIZE, SIZE_BYTES)
    title = f"Query photos while {backlog:,} uploads wait"
    with (
        printed_report(title, as_json) as (report, progress),
        open_fleet(
            extractor=f"test-slow-avg:milliseconds={milliseconds},width={DESCRIPTOR_DIMENSION}",
            batch_photos=batch,
        ) as fleet,
        contextlib.closing(connect(fleet.gateway_urls[0])) as connection,
    ):
        fleet.start()
        first = upload_all(fleet.gateway_urls[0], multipart_forms(photos, TEXTURES), 4)
        wait_for_jobs(fleet.catalog, TIMEOUT_SECONDS)
        _time_query(connection, photos[0])  # opens connections and loads what only queries need
        _insert_backlog(fleet, [UUID(answer["file_id"]) for answer in first], backlog)
        since = _wait_for_chunks(fleet, 3)
        bar = progress.add_task("searching", total=seconds)
        rng = random.Random(SEED)
        pause = 2 * milliseconds * batch / 1000
        latencies: list[float] = []
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            progress.update(bar, completed=seconds - left)
            time.sleep(rng.uniform(0, pause))
            latencies.append(_time_query(connection, rng.choice(photos)))
        periods = _batch_seconds(fleet, since, batch)
        report.add(
            "uploads still waiting at the end",
            count_unfinished_jobs(fleet.catalog, photos=True),
            at_least=1,
        )
        report.add("services that crashed", len(fleet.crashed), at_most=0)
        batch_ms = 1000 * statistics.median(periods)
        report.add("queries", len(latencies))
        report.add("a batch, p50", batch_ms, "ms")
        report.add_latency("query", latencies, worst_at_most_ms=batch_ms + TARGET_MS_ABOVE_BATCH)
        report.details = {"seconds": latencies, "batch_seconds": periods}


def _time_query(connection: HTTPConnection, photo: bytes) -> float:
    """Return the seconds until the response; AssertionError if there is none."""
    form = multipart_form(photo)
    sent_at = time.perf_counter()
    status, body = post_form(connection, "/api/v1/similarity?top_k=1", form, Prefer="wait=30")
    seconds = time.perf_counter() - sent_at
    assert status == 200, body
    return seconds


def _insert_backlog(fleet: Fleet, photo_ids: Sequence[UUID], count: int) -> None:
    """Insert uploads directly into the catalog, because sending thousands of photos takes long."""
    with fleet.catalog.write() as session:
        known = [session.get_one(Photo, photo_id) for photo_id in photo_ids]
        map_id = known[0].map_id
        keys = itertools.islice(itertools.cycle(photo.object_key for photo in known), count)
        photos = [made_up_photo(map_id, object_key=key, job_id=new_id()) for key in keys]
        session.execute(insert(Photo), photos)
        jobs = [
            {
                "id": photo["job_id"],
                "map_id": map_id,
                "kind": JobKind.INDEX,
                "priority": Priority.UPLOAD,
                "photo_id": photo["id"],
            }
            for photo in photos
        ]
        session.execute(insert(Job), jobs)


def _wait_for_chunks(fleet: Fleet, count: int) -> datetime:
    """Wait until the extractor has reached its steady state; return the database's time."""
    deadline = time.monotonic() + TIMEOUT_SECONDS
    with fleet.catalog.read() as session:
        before = session.scalar(select(func.count()).select_from(Chunk)) or 0
    while True:
        with fleet.catalog.read() as session:
            chunks = session.scalar(select(func.count()).select_from(Chunk)) or 0
            newest = session.scalars(select(Chunk.created_at).order_by(Chunk.id.desc())).first()
        if chunks >= before + count and newest is not None:
            return newest
        assert time.monotonic() < deadline, f"no batch is described: {fleet.logs()}"
        time.sleep(0.1)


def _batch_seconds(fleet: Fleet, since: datetime, batch: int) -> list[float]:
    """Return the time between commits of consecutive batches without a query between them."""
    with fleet.catalog.read() as session:
        commits = session.scalars(
            select(Chunk.created_at)
            .where(Chunk.created_at >= since, Chunk.rows == batch)  # merged chunks have more
            .order_by(Chunk.created_at)
        ).all()
        queries = session.scalars(
            select(Job.finished_at).where(
                Job.kind == JobKind.DESCRIBE, Job.state == JobState.SUCCEEDED
            )
        ).all()
    durations = [
        (after - before).total_seconds()
        for before, after in itertools.pairwise(commits)
        if not any(at is not None and before < at < after for at in queries)
    ]
    assert durations, "no batch came without a query between: query less often"
    return durations
