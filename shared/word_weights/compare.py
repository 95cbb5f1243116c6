"""Do weights help: the same queries, asked without and with them."""

from __future__ import annotations

import math
from fractions import Fraction

SIGNIFICANCE_LEVEL = 0.05


def sign_test_p_value(better: int, worse: int) -> float:
    """How probable so many improvements or more are where weights change nothing for the better.

    `better` queries were right with weights alone, `worse` without them alone. Of those that differ
    each is then a coin's throw: the exact one-sided sign test (McNemar 1947).
    """
    differ = better + worse
    as_good: int = sum(math.comb(differ, n) for n in range(better, differ + 1))
    return float(Fraction(as_good, 2**differ))


def is_significant_improvement(better: int, worse: int) -> bool:
    """More right than without weights, and by more than chance brings in one of twenty cases."""
    return better > worse and sign_test_p_value(better, worse) < SIGNIFICANCE_LEVEL
