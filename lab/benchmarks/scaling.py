"""Horizontal scaling: throughput of 1, 2, 4 ... extractors, and duplicate work.

    placewise bench scaling [--workers 1,2,4,8] [--photos 60] [--milliseconds 500] [--batch 4]

The extractors sleep instead of computing, so that many fit on one machine. What remains is the cost
of the job table, the Celery messages and publishing. Reported: photos per second for each number of
extractors; that rate relative to linear scaling; and photos described twice or not at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any
from uuid import UUID

from lab.benchmarks.fleet import Fleet, ServiceProcess, open_fleet
from lab.benchmarks.fleet.load_generator import (
    count_descriptions,
    load_jobs,
    make_jpegs,
    multipart_forms,
    upload_all,
    wait_for_jobs,
)
from lab.benchmarks.report import Report

if TYPE_CHECKING:
    from rich.progress import Progress

TARGET_EFFICIENCY = 0.9
CLIENTS = 4
MAX_WARM_UP_ROUNDS = 10
COMPACTION_DISABLED = 1_000_000  # keeps the chunks as the extractors wrote them
TIMEOUT_SECONDS = 900.0  # for one round


def measure(
    progress: Progress,
    *,
    workers: Sequence[int],
    photos: int,
    milliseconds: int,
    batch: int,
) -> Report:
    """Measure the throughput for each number of `workers`, with `photos` photos per worker.

    Workers sleep `milliseconds` per photo and take batches of `batch`.
    """
    report = Report("Scaling of extractors")
    with open_fleet(
        extractors=max(workers),
        extractor=f"test-slow-avg:milliseconds={milliseconds},width=16",
        batch_photos=batch,
        compact_chunks=COMPACTION_DISABLED,
        slot_rows=COMPACTION_DISABLED,
    ) as fleet:
        fleet.start("search-0-0", "gateway-0", "steward-0")
        sent = 0
        rates: dict[int, float] = {}
        for count in sorted(workers):
            extractors = [fleet[f"extractor-{number}"] for number in range(count)]
            fleet.start(*(one.name for one in extractors if not one.running))
            sent += _warm_up(fleet, extractors, 2 * count * batch)
            bar = progress.add_task(f"{count} extractors", total=photos * count)
            rates[count] = _measure_throughput(
                fleet,
                extractors,
                photos * count,
                lambda left, bar=bar, total=photos * count: progress.update(
                    bar, completed=total - left
                ),
            )
            sent += photos * count
        least = min(rates)
        for count, rate in rates.items():
            report.add(f"{count} extractors", rate, "photos/s")
        for count, rate in rates.items():
            if count > least:
                report.add(
                    f"{count} extractors / linear",
                    rate / (rates[least] * count / least),
                    at_least=TARGET_EFFICIENCY,
                )
        times = count_descriptions(fleet.store)
        report.add("photos described more than once", sum(n > 1 for n in times.values()), at_most=0)
        report.add("photos not described", sent - len(times), at_most=0)
        report.add("services that crashed", len(fleet.crashed), at_most=0)
    report.details = {"milliseconds": milliseconds, "batch": batch, "photos_each": photos}
    return report


def _warm_up(fleet: Fleet, extractors: Sequence[ServiceProcess], photos: int) -> int:
    """Upload until every extractor has described a batch; return the number of photos used."""
    expected_workers = {str(extractor.process.pid) for extractor in extractors}
    served: set[str] = set()
    for round_ in range(MAX_WARM_UP_ROUNDS):
        answers = _upload_photos(fleet, photos)
        wait_for_jobs(fleet.catalog, TIMEOUT_SECONDS)
        jobs = load_jobs(fleet.catalog, [UUID(answer["job_id"]) for answer in answers])
        served |= {(job.worker or "").rpartition("-")[2] for job in jobs}
        if expected_workers <= served:
            return photos * (round_ + 1)
    raise AssertionError(
        f"{len(expected_workers - served)} extractors claim no jobs: {fleet.logs()}"
    )


def _upload_photos(fleet: Fleet, photos: int) -> list[Any]:
    forms = multipart_forms(make_jpegs(8, (64, 48), 1500), photos)
    return upload_all(fleet.gateway_urls[0], forms, CLIENTS)


def _measure_throughput(
    fleet: Fleet, extractors: Sequence[ServiceProcess], photos: int, on_left: Any
) -> float:
    """Return photos per second from the first claim to the last commit, by the database's clock.

    All photos are queued before the first is claimed: the extractors are paused meanwhile.
    """
    for extractor in extractors:
        extractor.pause()
    try:
        answers = _upload_photos(fleet, photos)
    finally:
        for extractor in extractors:
            extractor.resume()
    wait_for_jobs(fleet.catalog, TIMEOUT_SECONDS, on_left)
    jobs = load_jobs(fleet.catalog, [UUID(answer["job_id"]) for answer in answers])
    started = [job.started_at for job in jobs if job.started_at]
    finished = [job.finished_at for job in jobs if job.finished_at]
    assert len(jobs) == len(started) == len(finished) == photos
    return photos / (max(finished) - min(started)).total_seconds()
