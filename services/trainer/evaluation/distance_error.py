"""How far from the query its first match was taken."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

DISTANCE_THRESHOLDS_M = (1, 2, 5, 10, 15, 20, 25, 30, 40, 50, 75, 100, 200, 500, 1000)


def distance_error(metres: NDArray[np.float64]) -> dict[str, Any] | None:
    """(queries,) metres, NaN where not known -> the shares of known ones that lie within x.

    None where none is known.
    """
    known = metres[np.isfinite(metres)]
    if not len(known):
        return None
    return {
        "queries": len(known),
        "without_position": int(len(metres) - len(known)),
        "median_m": float(np.median(known)),
        "within": [
            {"metres": x, "share": float((known <= x).mean())} for x in DISTANCE_THRESHOLDS_M
        ],
    }
