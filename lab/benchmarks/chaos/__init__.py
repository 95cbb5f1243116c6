"""Fault injection: components fail under uploads and queries, then invariants are checked.

    placewise bench chaos [--photos 2000] [--fault-seconds 30] [--seed 1]

`faults` defines the faults, `traffic` uploads and queries meanwhile, `run` injects one fault after
the other, in an order that the seed determines, and checks the invariants after each. Reported: for
each fault the time from its repair until every acknowledged photo was searchable; the number of
retried calls and of checked results; and the violations, which must all be zero.
"""

from lab.benchmarks.chaos.run import ChaosRun, run_chaos

__all__ = ["ChaosRun", "run_chaos"]
