"""The short form of `placewise bench chaos`: every kind of fault once, then the counts."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.chaos import run_chaos
from benchmarks.chaos.faults import all_faults

# What another one does, too, or does on another process: `placewise bench chaos` has them.
ANOTHER_OF_ITS_KIND = {
    "kill -9 of search-1-0",
    "FLUSHALL",  # a Redis that is stopped loses everything, too
    "PostgreSQL killed and started",  # one that is stopped is killed and stays away
    "connections to PostgreSQL refused",  # as those to a server that is stopped
    "connections to PostgreSQL cut",
    "connections to PostgreSQL slow",
    "connections to Redis refused",
    "connections to Redis cut",
    "connections to the S3 store refused",
    "connections to the S3 store slow",
}


@pytest.mark.timeout(900)
def test_whatever_dies_no_photo_is_lost_doubled_or_stuck_and_no_answer_is_wrong(
    tmp_path: Path,
) -> None:
    faults = [fault for fault in all_faults() if fault.name not in ANOTHER_OF_ITS_KIND]
    assert len(faults) == len(all_faults()) - len(ANOTHER_OF_ITS_KIND)
    run = run_chaos(
        tmp_path,
        photos=6 * len(faults),  # two before, two during and two after each fault
        fault_seconds=1.0,
        seed=20_261_121,
        faults=faults,
        queries_per_fault=3,
        query_interval_seconds=0.4,
        executed=False,
    )
    assert run.good, "\n".join([*map(str, run.outcomes), *run.details])
    assert len(run.outcomes) == len(faults)
    assert run.compared >= len(run.outcomes), "results were checked"
