"""The short form of `placewise bench chaos`: every fault once, then the counts."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.chaos import run_chaos
from benchmarks.chaos.faults import every_fault


@pytest.mark.timeout(900)
def test_whatever_dies_no_photo_is_lost_doubled_or_stuck_and_no_answer_is_wrong(
    tmp_path: Path,
) -> None:
    run = run_chaos(tmp_path, photos=200, fault_seconds=1.0, seed=20_261_121, executed=False)
    assert run.good, "\n".join([*map(str, run.outcomes), *run.details])
    assert len(run.outcomes) == len(every_fault())
    assert run.asked >= len(run.outcomes), "questions were compared with what is right"
