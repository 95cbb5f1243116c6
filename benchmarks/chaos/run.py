"""One fault after the other, and the counts after each."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.chaos.audit import InvariantViolations, check_invariants, count_unfinished_jobs
from benchmarks.chaos.faults import CLOCK_OFFSETS_SECONDS, Fault, all_faults
from benchmarks.chaos.traffic import Traffic
from benchmarks.fleet import Fleet, start_servers
from tests.support.clock import clock_off_by

RECOVERY_TIMEOUT_SECONDS = 180.0  # what has not recovered by then is counted as stuck
LEASE_SECONDS = 2.0
POLL_SECONDS = 0.1
QUERIES_PER_FAULT = (
    10  # known photos that are asked for after each fault, beside those asked for meanwhile
)
MAX_FAULT_DELAY_SECONDS = 0.5  # at most: how long the fault waits for uploads to be under way


@dataclass(slots=True)
class FaultOutcome:
    """After one fault. Everything but `refused` and `recovery_seconds` has to be zero."""

    fault: str
    counts: InvariantViolations
    wrong: int
    """Answers that did not begin with the photo that was asked with, or had one twice."""
    unexpected: int
    """Answers that were neither a result nor a request to try again, and calls without one."""
    crashed: list[str]
    """Services that ended although the fault did not kill them."""
    refused: int
    """Calls that had to be repeated."""
    recovery_seconds: float
    """From the repair until everything acknowledged was searchable."""

    @property
    def good(self) -> bool:
        return self.counts.none_found and not self.wrong and not self.unexpected


@dataclass(slots=True)
class ChaosRun:
    """What became of a run, fault by fault."""

    outcomes: list[FaultOutcome] = field(default_factory=list)
    asked: int = 0
    """Answers that were compared with what they had to be."""
    details: list[str] = field(default_factory=list)
    """Where something was not as it has to be: what, and the end of each service's log."""

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
    executed: bool = True,
    on_outcome: Callable[[FaultOutcome], object] = lambda outcome: None,
) -> ChaosRun:
    """Upload `photos` in equal parts, one for each fault, in an order that the seed decides.

    Faults that have a length last `fault_seconds`. Ends at the first fault after which something
    is not as it has to be, with the services' logs in the run. `executed`: see `Fleet`.
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
            compact_chunks=3,
            slot_rows=50,
            superseded_grace_seconds=5,
        ) as fleet,
    ):
        for name, seconds in CLOCK_OFFSETS_SECONDS.items():
            fleet[name].environment.update(clock_off_by(seconds))
        fleet.start()
        with Traffic(fleet.gateway_urls, seed) as traffic:
            for number, fault in enumerate(chosen):
                upload = _upload_by_thirds(traffic, photos, number, len(chosen))
                outcome = _run_fault(fleet, traffic, fault, fault_seconds, moments, upload)
                run.outcomes.append(outcome)
                on_outcome(outcome)
                if not outcome.good:
                    run.details += [*traffic.details, *outcome.counts.details, fleet.logs()]
                    break
            run.asked = traffic.answers["right"] + traffic.answers["wrong"]
    return run


def _upload_by_thirds(
    traffic: Traffic, photos: int, place: int, faults: int
) -> Callable[[int], None]:
    """Releases the first, second or third third of the part of the fault at `place`."""

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
) -> FaultOutcome:
    """Photos are uploaded before the fault, while it lasts, and after it; then all is counted."""
    before = traffic.answers.copy()
    fell = len(fleet.crashed)
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
        # Questions whose gateway died are answered to nobody, but answered.
        _wait_until(deadline, lambda: not count_unfinished_jobs(fleet.catalog))
        counts = check_invariants(fleet.catalog, fleet.store, traffic.acknowledged)
    for known in moments.sample(traffic.known, min(QUERIES_PER_FAULT, len(traffic.known))):
        traffic.ask(known)
    change = traffic.answers - before
    return FaultOutcome(
        fault=fault.name,
        counts=counts,
        wrong=change["wrong"],
        unexpected=change["unexpected"],
        crashed=fleet.crashed[fell:],
        refused=change["away"],
        recovery_seconds=recovery_seconds,
    )


def _wait_until(deadline: float, done: Callable[[], bool]) -> None:
    while not done() and time.monotonic() < deadline:
        time.sleep(POLL_SECONDS)
