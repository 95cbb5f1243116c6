"""One fault after the other, and the counts after each."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.chaos.audit import Counts, audit, unfinished
from benchmarks.chaos.faults import CLOCKS_OFF, Fault, every_fault
from benchmarks.chaos.traffic import Traffic
from benchmarks.fleet import Fleet, start_servers
from tests.support.clock import clock_off_by

RECOVERY_SECONDS = 180.0  # what has not recovered by then is counted as stuck
LEASE_SECONDS = 2.0
LOOK_SECONDS = 0.1
ASKED = 10  # known photos that are asked for after each fault, beside those asked for meanwhile
BEFORE_SECONDS = 0.5  # at most: how long the fault waits for uploads to be under way


@dataclass(slots=True)
class Outcome:
    """After one fault. Everything but `refused` and `recovery_seconds` has to be zero."""

    fault: str
    counts: Counts
    wrong: int
    """Answers that did not begin with the photo that was asked with, or had one twice."""
    unexpected: int
    """Answers that were neither a result nor a request to try again, and calls without one."""
    fell: list[str]
    """Services that ended although the fault did not kill them."""
    refused: int
    """Calls that had to be repeated."""
    recovery_seconds: float
    """From the repair until everything acknowledged was searchable."""

    @property
    def good(self) -> bool:
        return self.counts.all_zero and not self.wrong and not self.unexpected


@dataclass(slots=True)
class Run:
    """What became of a run, fault by fault."""

    outcomes: list[Outcome] = field(default_factory=list)
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
    on_outcome: Callable[[Outcome], object] = lambda outcome: None,
) -> Run:
    """Upload `photos` in equal parts, one for each fault, in an order that the seed decides.

    Faults that have a length last `fault_seconds`. Ends at the first fault after which something
    is not as it has to be, with the services' logs in the run. `executed`: see `Fleet`.
    """
    moments = random.Random(seed)
    chosen = list(faults or every_fault())
    moments.shuffle(chosen)
    run = Run()
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
        for name, seconds in CLOCKS_OFF.items():
            fleet[name].environment.update(clock_off_by(seconds))
        fleet.start()
        with Traffic(fleet.gateway_urls, seed) as traffic:
            for number, fault in enumerate(chosen):
                upload = _thirds(traffic, photos, number, len(chosen))
                outcome = _do(fleet, traffic, fault, fault_seconds, moments, upload)
                run.outcomes.append(outcome)
                on_outcome(outcome)
                if not outcome.good:
                    run.details += [*traffic.details, *outcome.counts.details, fleet.logs()]
                    break
            run.asked = traffic.answers["right"] + traffic.answers["wrong"]
    return run


def _thirds(traffic: Traffic, photos: int, place: int, faults: int) -> Callable[[int], None]:
    """Releases the first, second or third third of the part of the fault at `place`."""

    def upload(third: int) -> None:
        traffic.release((3 * place + third) * photos // (3 * faults))

    return upload


def _do(
    fleet: Fleet,
    traffic: Traffic,
    fault: Fault,
    seconds: float,
    moments: random.Random,
    upload: Callable[[int], None],
) -> Outcome:
    """Photos are uploaded before the fault, while it lasts, and after it; then all is counted."""
    before = traffic.answers.copy()
    fell = len(fleet.fell)
    upload(1)
    time.sleep(moments.uniform(0, BEFORE_SECONDS))
    with fault.broken(fleet, seconds):
        upload(2)
    repaired = time.monotonic()
    upload(3)
    deadline = repaired + RECOVERY_SECONDS
    _wait(deadline, lambda: traffic.all_acknowledged and not unfinished(fleet.catalog, photos=True))
    recovery_seconds = time.monotonic() - repaired
    traffic.remember()
    with traffic.nobody_asks():
        # Questions whose gateway died are answered to nobody, but answered.
        _wait(deadline, lambda: not unfinished(fleet.catalog))
        counts = audit(fleet.catalog, fleet.store, traffic.acknowledged)
    for known in moments.sample(traffic.known, min(ASKED, len(traffic.known))):
        traffic.ask(known)
    change = traffic.answers - before
    return Outcome(
        fault=fault.name,
        counts=counts,
        wrong=change["wrong"],
        unexpected=change["unexpected"],
        fell=fleet.fell[fell:],
        refused=change["away"],
        recovery_seconds=recovery_seconds,
    )


def _wait(deadline: float, done: Callable[[], bool]) -> None:
    while not done() and time.monotonic() < deadline:
        time.sleep(LOOK_SECONDS)
