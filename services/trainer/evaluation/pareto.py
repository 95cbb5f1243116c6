"""Which of several descriptors are worth their price."""

from __future__ import annotations

import math
from collections.abc import Sequence


def pareto_front(costs: Sequence[float], values: Sequence[float]) -> list[bool]:
    """Whether nothing else is at least as good in both and better in one: cheaper, or worth more.

    One whose price is NaN (not measured) is never on the front.
    """
    points = list(zip(costs, values, strict=True))
    return [
        not math.isnan(price)
        and not any(
            other_price <= price
            and other_worth >= worth
            and (other_price < price or other_worth > worth)
            for other_price, other_worth in points
        )
        for price, worth in points
    ]
