"""The short form of `placewise bench chaos`: a fault of each component, then the counts."""

from __future__ import annotations

import pytest

from lab.benchmarks.chaos import all_faults, run_chaos

# What no other test does to a whole deployment. `placewise bench chaos` injects all faults; those
# on one component are also in the other modules of this folder, in tests/contract/storage (a store
# that is full, refuses, cuts or is slow) and in tests/integration (a search worker that is silent
# or killed, hints that are doubled or lost).
FAULTS = {
    "kill -9 of gateway-0",
    "kill -9 of extractor-0",
    "kill -9 of every service at once",
    "an extractor stands still beyond its lease",
    "Redis stopped",
    "PostgreSQL stopped",
    "the S3 store killed",
}


@pytest.mark.timeout(900)
def test_killed_services_lose_and_duplicate_no_photo_and_give_no_wrong_answer() -> None:
    faults = [fault for fault in all_faults() if fault.name in FAULTS]
    assert len(faults) == len(FAULTS)
    run = run_chaos(
        photos=6 * len(faults),  # two before, two during and two after each fault
        fault_seconds=1.0,
        seed=20_261_121,
        faults=faults,
        queries_per_fault=3,
        query_interval_seconds=1.0,
        executed=False,
    )
    assert run.good, "\n".join([*map(str, run.outcomes), *run.details])
    assert len(run.outcomes) == len(faults)
    assert run.compared >= len(run.outcomes), "results were checked"
