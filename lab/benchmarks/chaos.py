"""Fault injection: components fail under uploads and queries, then invariants are checked.

    placewise bench chaos [--photos 2000] [--fault-seconds 30] [--seed 1]

One fault follows the other, in the seed's order. Reported: the seconds from each repair until all
photos were searchable, and the violations (`invariants`): none.
"""

from __future__ import annotations

import contextlib
import hashlib
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Self
from uuid import UUID

import httpx2
import typer

from lab.benchmarks.fault_injection import MessageDuplicator, ProxyMode
from lab.benchmarks.fleet import Fleet, open_fleet
from lab.benchmarks.invariants import InvariantViolations, check_invariants, count_unfinished_jobs
from lab.benchmarks.report import printed_report
from services.cli.output import JsonOption
from tests.support.clock import clock_off_by
from tests.support.photos import photo_bytes
from tests.support.server import SERVICES_KEY
from tests.support.servers.handle import Handle

# Services whose clock is wrong during the whole run, by so many seconds. S3 servers reject what is
# signed with a clock that is off by more than 900.
CLOCK_OFFSETS_SECONDS = {
    "gateway-1": 600,
    "extractor-1": 600,
    "extractor-2": -600,
    "search-1": -600,
    "steward-0": 600,
}


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of the suite: `begin` breaks a component, and `end` repairs it."""

    name: str
    begin: Callable[[Fleet], object]
    end: Callable[[Fleet], object]
    seconds: float | None = 0.0
    """How long it lasts; None: as long as the run says"""

    @contextlib.contextmanager
    def inject(self, fleet: Fleet, seconds: float) -> Iterator[None]:
        """Break the component on entry, and repair it after the body of the `with` block."""
        self.begin(fleet)
        try:
            yield
            time.sleep(seconds if self.seconds is None else self.seconds)
        finally:
            self.end(fleet)


def all_faults() -> list[Fault]:
    """Return all faults in the order of the documentation; a run shuffles them."""
    return [
        *map(_kill, ("gateway-0", "extractor-0", "search-0", "search-1", "steward-0")),
        Fault("kill -9 of every service at once", Fleet.kill_all, Fleet.start),
        _pause("an extractor stands still beyond its lease", "extractor-0"),
        _pause("a search worker stands still", "search-0"),
        Fault("FLUSHALL", lambda f: f.servers.redis.flush(), lambda f: f.servers.redis.flush()),
        _stop("Redis stopped", "Redis"),
        _stop("Redis stopped for two minutes", "Redis", 120.0),
        *(
            _stop(f"Redis paused {n} s", "Redis", n, Handle.pause, Handle.resume)
            for n in (7, 16, 90)
        ),
        Fault(
            "Redis full", lambda f: f.servers.redis.fill(), lambda f: f.servers.redis.empty(), None
        ),
        _duplicate_messages(),
        _stop("PostgreSQL killed and started", "PostgreSQL", 0.0),
        _stop("PostgreSQL stopped", "PostgreSQL"),
        _stop("the S3 store killed", "the S3 store"),
        _disconnect("the S3 store full (507)", "the S3 store", ProxyMode.FULL),
        *(
            _disconnect(f"connections to {server} {mode.name.lower()}", server, mode)
            for server in ("PostgreSQL", "Redis", "the S3 store")
            for mode in (ProxyMode.REFUSED, ProxyMode.CUT, ProxyMode.SLOW)
        ),
    ]


def _kill(name: str) -> Fault:
    return Fault(
        f"kill -9 of {name}", lambda fleet: fleet[name].kill(), lambda fleet: fleet.start(name)
    )


def _pause(title: str, name: str) -> Fault:
    def resume(fleet: Fleet) -> None:
        time.sleep(2 * fleet.lease_seconds)
        fleet[name].signal(signal.SIGCONT)

    return Fault(title, lambda fleet: fleet[name].signal(signal.SIGSTOP), resume)


def _stop(
    title: str,
    server: str,
    seconds: float | None = None,
    begin: Callable[[Handle], object] = Handle.kill,
    end: Callable[[Handle], object] = Handle.start,
) -> Fault:
    return Fault(
        title,
        lambda fleet: begin(fleet.servers.processes[server]),
        lambda fleet: end(fleet.servers.processes[server]),
        seconds,
    )


def _disconnect(title: str, server: str, mode: ProxyMode) -> Fault:
    return Fault(
        title,
        lambda fleet: fleet.servers.proxies[server].set_mode(mode),
        lambda fleet: fleet.servers.proxies[server].set_mode(ProxyMode.OPEN),
        None,
    )


def _duplicate_messages() -> Fault:
    stack = contextlib.ExitStack()
    return Fault(
        "every message doubled",
        lambda fleet: stack.enter_context(MessageDuplicator(fleet.servers.redis.url).duplicating()),
        lambda fleet: stack.close(),
        None,
    )


UPLOADERS = 4
CALL_TIMEOUT_SECONDS = 60.0
RETRY_SECONDS = 0.1
MIN_SELF_SCORE = 0.9999
RETRYABLE_STATUSES = (429, 503, 507)


class Traffic:
    """Uploads photos as they are released, and queries with them; retries at the next gateway."""

    def __init__(self, urls: Sequence[str], seed: int, query_interval_seconds: float) -> None:
        self._query_interval_seconds = query_interval_seconds
        self._random = random.Random(seed)
        headers = {"Authorization": f"Bearer {SERVICES_KEY}"}
        self._clients = [
            httpx2.Client(base_url=url, headers=headers, timeout=CALL_TIMEOUT_SECONDS)
            for url in urls
        ]
        self._lock = threading.Lock()
        self._released = 0
        self._next = 0
        self._stop = threading.Event()
        self.querying = threading.Lock()
        """Held while a query is in progress."""
        self._numbers: dict[UUID, int] = {}
        self.acknowledged: dict[str, UUID] = {}
        self.known: list[int] = []
        """Numbers of photos that every result must contain."""
        self.answers: Counter[str] = Counter()
        """How calls went: `acknowledged`, `right`, `wrong`, `unexpected`, `retried`."""
        self.details: list[str] = []
        self._threads = [
            *(threading.Thread(target=self._upload, args=(n,)) for n in range(UPLOADERS)),
            threading.Thread(target=self._query_loop),
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.daemon = True
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        for client in self._clients:
            client.close()

    def release(self, photos: int) -> None:
        """Allow this total number of photos to be uploaded."""
        self._released = photos

    @property
    def all_acknowledged(self) -> bool:
        return len(self.acknowledged) >= self._released

    def mark_searchable(self) -> None:
        """Require from now on that each result contains the acknowledged photos."""
        with self._lock:
            self.known = sorted(self._numbers.values())

    def _upload(self, caller: int) -> None:
        while not self._stop.is_set():
            with self._lock:
                number = self._next if self._next < self._released else None
                if number is not None:
                    self._next += 1
            if number is None:
                self._stop.wait(0.02)
                continue
            data = photo_bytes(number)
            tries = caller
            while not self._stop.is_set():
                body = self._call(
                    tries, "/api/v1/upload", (200, 202), files={"file": (f"{number}.jpg", data)}
                )
                if body is not None:
                    photo_id = UUID(body["file_id"])
                    with self._lock:
                        self.acknowledged[hashlib.sha256(data).hexdigest()] = photo_id
                        self._numbers[photo_id] = number
                    self.answers["acknowledged"] += 1
                    break
                tries += 1
                self._stop.wait(RETRY_SECONDS)

    def _query_loop(self) -> None:
        while not self._stop.wait(self._query_interval_seconds):
            with self._lock:
                number = self._random.choice(self.known) if self.known else None
            if number is not None:
                with self.querying:
                    self.query(number)

    def query(self, number: int) -> None:
        """Query with the bytes of an acknowledged photo and check the result."""
        body = self._call(
            self._random.randrange(len(self._clients)),
            "/api/v1/similarity",
            (200, 202),
            files={"file": ("query.jpg", photo_bytes(number))},
            params={"top_k": 5},
            headers={"Prefer": "wait=10"},
        )
        if body is None or "similar_images" not in body or body["missing"]:
            return  # retried, not ready in time, or a chunk is missing
        found = body["similar_images"]
        ids = [photo["image_id"] for photo in found]
        right = (
            bool(found)
            and self._numbers.get(UUID(ids[0])) == number
            and found[0]["similarity_score"] > MIN_SELF_SCORE
            and len(set(ids)) == len(ids)
        )
        self.answers["right" if right else "wrong"] += 1
        if not right:
            self.details.append(f"query with photo {number}: {found[:2]}")

    def _call(
        self, caller: int, path: str, expected: Sequence[int], **options: Any
    ) -> dict[str, Any] | None:
        """Return the response body; None if the caller should retry."""
        number = caller % len(self._clients)
        started_at = time.monotonic()
        try:
            answer = self._clients[number].post(path, **options)
        except httpx2.TransportError as error:
            self.answers["retried"] += 1
            if isinstance(error, httpx2.ReadTimeout):
                self.answers["unexpected"] += 1
                seconds = time.monotonic() - started_at
                self.details.append(f"{path} did not answer in {seconds:.0f} s")
            return None
        if answer.status_code in expected:
            body: dict[str, Any] = answer.json()
            return body
        if answer.status_code in RETRYABLE_STATUSES:
            self.answers["retried"] += 1
        else:
            self.answers["unexpected"] += 1
            self.details.append(f"{path} answered {answer.status_code}: {answer.text[:500]}")
        return None


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

    Faults without a duration of their own last `fault_seconds`. Queries are sent all the time, and
    `queries_per_fault` more after each fault. The run ends at the first fault that leaves a
    violation, with the services' logs. `executed`: see `Fleet`.
    """
    moments = random.Random(seed)
    chosen = list(faults or all_faults())
    moments.shuffle(chosen)
    run = ChaosRun()
    with open_fleet(
        gateways=2,
        extractors=3,
        replicas=2,
        through_proxies=True,
        executed=executed,
        extractor="test-slow-avg:milliseconds=20,width=256",  # so that a kill finds it at work
        lease_seconds=LEASE_SECONDS,
        batch_photos=8,
        slot_rows=50,
    ) as fleet:
        for name, seconds in CLOCK_OFFSETS_SECONDS.items():
            fleet[name].environment.update(clock_off_by(seconds))
        fleet.start()
        with Traffic(fleet.gateway_urls, seed, query_interval_seconds) as traffic:
            for number, fault in enumerate(chosen):
                thirds = [(3 * number + third) * photos // (3 * len(chosen)) for third in (1, 2, 3)]
                outcome = _run_fault(
                    fleet, traffic, fault, fault_seconds, moments, thirds, queries_per_fault
                )
                run.outcomes.append(outcome)
                on_outcome(outcome)
                if not outcome.good:
                    run.details += [*traffic.details, *outcome.counts.details, fleet.logs()]
                    break
            run.compared = traffic.answers["right"] + traffic.answers["wrong"]
    return run


def _run_fault(
    fleet: Fleet,
    traffic: Traffic,
    fault: Fault,
    seconds: float,
    moments: random.Random,
    thirds: Sequence[int],
    queries: int,
) -> FaultOutcome:
    """Upload photos before, during and after the fault, then check."""
    before = traffic.answers.copy()
    crashed = len(fleet.crashed)
    traffic.release(thirds[0])
    time.sleep(moments.uniform(0, MAX_FAULT_DELAY_SECONDS))
    with fault.inject(fleet, seconds):
        traffic.release(thirds[1])
    repaired = time.monotonic()
    traffic.release(thirds[2])
    deadline = repaired + RECOVERY_TIMEOUT_SECONDS
    _wait_until(
        deadline,
        lambda: traffic.all_acknowledged and not count_unfinished_jobs(fleet.catalog, photos=True),
    )
    recovery_seconds = time.monotonic() - repaired
    traffic.mark_searchable()
    with traffic.querying:
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
    title = f"{photos} photos, {len(faults)} faults, seed {seed}"
    with printed_report(title, as_json) as (report, progress):
        bar = progress.add_task("injecting faults", total=len(faults))
        run = run_chaos(
            photos=photos,
            fault_seconds=fault_seconds,
            seed=seed,
            on_outcome=lambda outcome: progress.update(bar, advance=1, description=outcome.fault),
        )
        outcomes = run.outcomes
        for outcome in outcomes:
            report.add(f"recovered after: {outcome.fault}", outcome.recovery_seconds, "s")
        report.add("faults injected", len(outcomes), at_least=len(faults))
        report.add("calls repeated", sum(outcome.refused for outcome in outcomes))
        report.add("responses compared", run.compared)
        for what, values in (
            ("photos lost", [outcome.counts.lost for outcome in outcomes]),
            ("photos searchable twice", [outcome.counts.twice for outcome in outcomes]),
            ("jobs stuck", [outcome.counts.stuck for outcome in outcomes]),
            ("jobs failed", [outcome.counts.failed for outcome in outcomes]),
            ("chunks torn", [outcome.counts.torn for outcome in outcomes]),
            ("wrong matches", [outcome.wrong for outcome in outcomes]),
            ("unexpected responses", [outcome.unexpected for outcome in outcomes]),
        ):
            report.add(what, sum(values), at_most=0)
        report.details = {
            "crashed": [name for outcome in outcomes for name in outcome.crashed],
            "violations": run.details,
        }
