"""Runs the fault-injection suite and checks the invariants after each fault."""

from __future__ import annotations

import hashlib
import random
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated
from uuid import UUID

import typer
from sqlalchemy import ColumnElement, func, select

from lab.benchmarks.chaos.faults import CLOCK_OFFSETS_SECONDS, Fault, all_faults
from lab.benchmarks.chaos.traffic import Traffic
from lab.benchmarks.fleet import Fleet, start_servers
from lab.benchmarks.report import printed_report
from services.cli.output import JsonOption
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.jobs import UNFINISHED_STATES, JobKind, JobState
from shared.catalog.photos import Photo
from shared.errors import NotFound
from shared.jobs import Job
from shared.storage import ObjectStore
from shared.storage.chunks import manifest_key
from tests.support.clock import clock_off_by


@dataclass(slots=True)
class InvariantViolations:
    """Numbers of violations of each invariant; all must be zero."""

    lost: int = 0
    """Acknowledged photos that the catalog or the store does not have, or that have no row."""
    twice: int = 0
    """Photos with more than one row in the active generation, or stored twice."""
    stuck: int = 0
    """Jobs that have not ended."""
    failed: int = 0
    """Jobs that ended with an error, although nothing is wrong with any photo."""
    torn: int = 0
    """Live chunks whose bytes or manifest are not what the catalog says."""
    details: list[str] = field(default_factory=list)

    @property
    def none_found(self) -> bool:
        return not (self.lost or self.twice or self.stuck or self.failed or self.torn)


def count_unfinished_jobs(catalog: Catalog, *, photos: bool = False) -> int:
    """Count unfinished jobs; with `photos`, without the jobs of queries."""
    conditions: list[ColumnElement[bool]] = [Job.state.in_(UNFINISHED_STATES)]
    if photos:
        conditions.append(Job.kind != JobKind.DESCRIBE)
    with catalog.read() as session:
        return session.scalar(select(func.count()).select_from(Job).where(*conditions)) or 0


def check_invariants(
    catalog: Catalog, store: ObjectStore, acknowledged: Mapping[str, UUID]
) -> InvariantViolations:
    """Count violations; `acknowledged` maps the sha256 of each acknowledged photo to its id."""
    counts = InvariantViolations()
    with catalog.read() as session:
        photos = {
            photo.id: photo
            for photo in session.scalars(select(Photo).where(Photo.deleted_at.is_(None)))
        }
        rows = Counter(
            session.scalars(
                select(Descriptor.photo_id)
                .join(Generation, Generation.id == Descriptor.generation_id)
                .where(Generation.state == GenerationState.ACTIVE)
            )
        )
        chunks = session.scalars(select(Chunk).where(Chunk.superseded_at.is_(None))).all()
        failed = session.scalars(select(Job).where(Job.state == JobState.FAILED)).all()
    counts.stuck = count_unfinished_jobs(catalog)
    counts.failed = len(failed)
    counts.details += [f"the job {job.id} ({job.kind}) failed: {job.error}" for job in failed]
    stored = {info.key for info in store.list("originals/")}
    for sha256, photo_id in acknowledged.items():
        photo = photos.get(photo_id)
        if photo is None or photo.sha256 != sha256:
            counts.details.append(f"acknowledged photo {photo_id} is not in the catalog")
        elif photo.object_key not in stored:
            counts.details.append(f"acknowledged photo {photo_id} is not in the object store")
        elif not rows[photo_id]:
            counts.details.append(f"acknowledged photo {photo_id} has no descriptor")
        else:
            continue
        counts.lost += 1
    by_sha256 = Counter(photo.sha256 for photo in photos.values())
    duplicates = [sha256 for sha256, times in by_sha256.items() if times > 1]
    described_twice = [photo_id for photo_id, times in rows.items() if times > 1]
    counts.twice = len(duplicates) + len(described_twice)
    counts.details += [f"{sha256} is stored {by_sha256[sha256]} times" for sha256 in duplicates]
    counts.details += [f"{photo_id} has {rows[photo_id]} rows" for photo_id in described_twice]
    for chunk in chunks:
        if not _is_intact(store, chunk):
            counts.torn += 1
            counts.details.append(
                f"chunk {chunk.object_key} does not match its hash in the catalog"
            )
    return counts


def _is_intact(store: ObjectStore, chunk: Chunk) -> bool:
    try:
        data, manifest = store.get(chunk.object_key), store.get(manifest_key(chunk.object_key))
    except NotFound:
        return False
    return hashlib.sha256(data).hexdigest() == chunk.sha256 and chunk.sha256.encode() in manifest


RECOVERY_TIMEOUT_SECONDS = 180.0  # jobs that are unfinished after it count as stuck
LEASE_SECONDS = 2.0
POLL_SECONDS = 0.1
MAX_FAULT_DELAY_SECONDS = 0.5  # the fault starts this long after the uploads at the latest


@dataclass(slots=True)
class FaultOutcome:
    """Result of one fault. All values except `refused` and `recovery_seconds` must be zero."""

    fault: str
    counts: InvariantViolations
    wrong: int
    """Results that did not begin with the query photo, or contained a photo twice."""
    unexpected: int
    """Responses that were neither a result nor retryable, and calls without a response."""
    crashed: list[str]
    """Services that exited although the fault did not kill them."""
    refused: int
    """Calls that had to be repeated."""
    recovery_seconds: float
    """From the repair until everything acknowledged was searchable."""

    @property
    def good(self) -> bool:
        return self.counts.none_found and not self.wrong and not self.unexpected


@dataclass(slots=True)
class ChaosRun:
    """Results of a run, by fault."""

    outcomes: list[FaultOutcome] = field(default_factory=list)
    compared: int = 0
    """Number of search results that were checked."""
    details: list[str] = field(default_factory=list)
    """Violations, and the end of each service's log."""

    @property
    def good(self) -> bool:
        return all(outcome.good for outcome in self.outcomes)


def run_chaos(
    folder: Path,
    *,
    photos: int,
    fault_seconds: float,
    seed: int,
    faults: Sequence[Fault] | None = None,
    queries_per_fault: int = 10,
    query_interval_seconds: float = 0.1,
    executed: bool = True,
    on_outcome: Callable[[FaultOutcome], object] = lambda outcome: None,
) -> ChaosRun:
    """Upload `photos` in equal parts, one per fault; the seed determines the order of the faults.

    Faults that have a duration last `fault_seconds`. Queries are sent every
    `query_interval_seconds`, and `queries_per_fault` more after each fault. The run ends at the
    first fault that leaves a violation; the services' logs are then part of the result. `executed`:
    see `Fleet`.
    """
    moments = random.Random(seed)
    chosen = list(faults or all_faults())
    moments.shuffle(chosen)
    run = ChaosRun()
    with (
        start_servers() as servers,
        Fleet(
            folder,
            servers,
            gateways=2,
            extractors=3,
            shards=2,
            through_proxies=True,
            executed=executed,
            extractor="test-slow-avg:milliseconds=20,width=256",  # so that a kill finds it at work
            lease_seconds=LEASE_SECONDS,
            batch_photos=8,
            slot_rows=50,
        ) as fleet,
    ):
        for name, seconds in CLOCK_OFFSETS_SECONDS.items():
            fleet[name].environment.update(clock_off_by(seconds))
        fleet.start()
        with Traffic(fleet.gateway_urls, seed, query_interval_seconds) as traffic:
            for number, fault in enumerate(chosen):
                upload = _upload_by_thirds(traffic, photos, number, len(chosen))
                outcome = _run_fault(
                    fleet, traffic, fault, fault_seconds, moments, upload, queries_per_fault
                )
                run.outcomes.append(outcome)
                on_outcome(outcome)
                if not outcome.good:
                    run.details += [*traffic.details, *outcome.counts.details, fleet.logs()]
                    break
            run.compared = traffic.answers["right"] + traffic.answers["wrong"]
    return run


def _upload_by_thirds(
    traffic: Traffic, photos: int, place: int, faults: int
) -> Callable[[int], None]:
    """Release the first, second or third third of the photos of the fault at index `place`."""

    def upload(third: int) -> None:
        traffic.release((3 * place + third) * photos // (3 * faults))

    return upload


def _run_fault(
    fleet: Fleet,
    traffic: Traffic,
    fault: Fault,
    seconds: float,
    moments: random.Random,
    upload: Callable[[int], None],
    queries: int,
) -> FaultOutcome:
    """Upload photos before, during and after the fault, then check the invariants and query."""
    before = traffic.answers.copy()
    crashed = len(fleet.crashed)
    upload(1)
    time.sleep(moments.uniform(0, MAX_FAULT_DELAY_SECONDS))
    with fault.inject(fleet, seconds):
        upload(2)
    repaired = time.monotonic()
    upload(3)
    deadline = repaired + RECOVERY_TIMEOUT_SECONDS
    _wait_until(
        deadline,
        lambda: traffic.all_acknowledged and not count_unfinished_jobs(fleet.catalog, photos=True),
    )
    recovery_seconds = time.monotonic() - repaired
    traffic.mark_searchable()
    with traffic.pause_queries():
        # The jobs of queries whose gateway was killed still complete, although nobody waits.
        _wait_until(deadline, lambda: not count_unfinished_jobs(fleet.catalog))
        counts = check_invariants(fleet.catalog, fleet.store, traffic.acknowledged)
    for known in moments.sample(traffic.known, min(queries, len(traffic.known))):
        traffic.query(known)
    change = traffic.answers - before
    return FaultOutcome(
        fault=fault.name,
        counts=counts,
        wrong=change["wrong"],
        unexpected=change["unexpected"],
        crashed=fleet.crashed[crashed:],
        refused=change["retried"],
        recovery_seconds=recovery_seconds,
    )


def _wait_until(deadline: float, done: Callable[[], bool]) -> None:
    while not done() and time.monotonic() < deadline:
        time.sleep(POLL_SECONDS)


def bench(
    photos: Annotated[
        int, typer.Option(min=30, help="Photos to upload while services are killed.")
    ] = 2000,
    fault_seconds: Annotated[float, typer.Option(min=0.1, help="Duration of each outage.")] = 30,
    seed: Annotated[int, typer.Option(help="Seed of the order and times of faults.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Kill every service and server in turn; check that nothing is lost, duplicated or stuck."""
    faults = all_faults()
    with (
        printed_report(f"{photos} photos, {len(faults)} faults, seed {seed}", as_json) as (
            report,
            progress,
        ),
        tempfile.TemporaryDirectory() as folder,
    ):
        bar = progress.add_task("injecting faults", total=len(faults))

        def show(outcome: FaultOutcome) -> None:
            progress.update(bar, advance=1, description=outcome.fault)

        run = run_chaos(
            Path(folder), photos=photos, fault_seconds=fault_seconds, seed=seed, on_outcome=show
        )
        for outcome in run.outcomes:
            report.add(f"recovered after: {outcome.fault}", outcome.recovery_seconds, "s")
        report.add("faults injected", len(run.outcomes), at_least=len(faults))
        report.add("calls repeated", sum(outcome.refused for outcome in run.outcomes))
        report.add("responses compared", run.compared)
        for what, values in (
            ("photos lost", [outcome.counts.lost for outcome in run.outcomes]),
            ("photos searchable twice", [outcome.counts.twice for outcome in run.outcomes]),
            ("jobs stuck", [outcome.counts.stuck for outcome in run.outcomes]),
            ("jobs failed", [outcome.counts.failed for outcome in run.outcomes]),
            ("chunks torn", [outcome.counts.torn for outcome in run.outcomes]),
            ("wrong matches", [outcome.wrong for outcome in run.outcomes]),
            ("unexpected responses", [outcome.unexpected for outcome in run.outcomes]),
        ):
            report.add(what, sum(values), at_most=0)
        report.details = {
            "crashed": [name for outcome in run.outcomes for name in outcome.crashed],
            "violations": run.details,
        }
