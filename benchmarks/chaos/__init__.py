"""Fault-injection suite: components fail under uploads and queries, then invariants are checked.

`faults` defines the faults, `traffic` uploads and queries meanwhile, `run` injects one fault after
the other and checks the invariants after each.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.chaos.faults import all_faults
from benchmarks.chaos.run import ChaosRun, FaultOutcome, run_chaos
from benchmarks.report import Report

if TYPE_CHECKING:
    from rich.progress import Progress

__all__ = ["ChaosRun", "measure", "run_chaos"]


def measure(progress: Progress, *, photos: int, fault_seconds: float, seed: int) -> Report:
    """Inject every fault once, in a random order that is determined by the seed."""
    faults = all_faults()
    bar = progress.add_task("breaking things", total=len(faults))

    def show(outcome: FaultOutcome) -> None:
        progress.update(bar, advance=1, description=outcome.fault)

    with tempfile.TemporaryDirectory() as folder:
        run = run_chaos(
            Path(folder), photos=photos, fault_seconds=fault_seconds, seed=seed, on_outcome=show
        )
    report = Report(f"{photos} photos, {len(run.outcomes)} faults of {len(faults)}, seed {seed}")
    counted: Counter[str] = Counter()
    for outcome in run.outcomes:
        counts = outcome.counts
        report.add(f"recovered after: {outcome.fault}", outcome.recovery_seconds, "s")
        counted["calls repeated"] += outcome.refused
        counted["photos lost"] += counts.lost
        counted["photos searchable twice"] += counts.twice
        counted["jobs stuck"] += counts.stuck
        counted["jobs failed"] += counts.failed
        counted["chunks torn"] += counts.torn
        counted["wrong matches"] += outcome.wrong
        counted["unexpected answers"] += outcome.unexpected
    report.add("calls repeated", counted.pop("calls repeated", 0))
    report.add("answers compared", run.asked)
    for what, count in counted.items():
        report.add(what, count, at_most=0)
    report.details = {
        "fell": [name for o in run.outcomes for name in o.crashed],
        "found": run.details,
    }
    return report
