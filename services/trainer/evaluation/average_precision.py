"""Mean average precision of rankings that end at k."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.trainer.evaluation.hits import Hits


def average_precisions(hits: Hits, positive_counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """(queries, k) hits, (queries,) how many positives each has -> (queries,) AP@k.

    AP@k is the sum, over the right ones among the first k, of the precision at their rank, divided
    by min(positives, k): 1 where nothing wrong stands before what could be found (Manning et al.,
    Introduction to Information Retrieval, 8.4, cut at k). NaN for a query without positives: leave
    those out of the mean.
    """
    ranks = np.arange(1, hits.shape[1] + 1)
    precision = np.cumsum(hits, axis=1) / ranks
    sums = (precision * hits).sum(axis=1)
    findable = np.minimum(positive_counts, hits.shape[1]).astype(np.float64)
    unknown = np.full(len(sums), np.nan)
    precisions: NDArray[np.float64] = np.divide(sums, findable, out=unknown, where=findable > 0)
    return precisions
