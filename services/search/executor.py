"""Query executor: runs a query on a snapshot with the cheapest suitable search strategy.

The strategies are the dense scan and sign codes. Both compare the best candidates exactly
and rank by float64 cosines; they differ in the certificate of the result.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.dense_scan import QueryRow, scan_top_k
from services.search.query_batcher import QueryBatcher
from services.search.snapshot import Snapshot
from shared.search_api.protocol import EXHAUSTIVE, NONE, STATISTICAL, SearchHit, SearchResponse

# Largest plausible error in standard deviations (exceeded by one row in ten million); beyond it
# the sign codes are not trusted.
MAX_Z = 5.5

# Rounding makes equal rows have equal scores whatever the summation order; ties go by photo id.
SCORE_DECIMALS = 12

RowNumbers = NDArray[np.int64]
Scores = NDArray[np.float64]

NO_ROWS = np.empty(0, np.int64)
NO_SCORES = np.empty(0)


@dataclass(frozen=True, slots=True, eq=False)
class _ScoredRows:
    """Rows with their exact scores, among them all that the result needs."""

    rows: RowNumbers
    scores: Scores
    certificate: str
    scanned: int
    max_z: float | None = None


def execute_query(
    snapshot: Snapshot,
    query: QueryRow,
    row_mask: NDArray[np.bool_],
    k: int,
    batcher: QueryBatcher,
) -> SearchResponse:
    """Search the rows of a snapshot that are most similar to a query.

    Args:
        snapshot: The snapshot.
        query: (dimension,) row of any length; a row of zeros has no similar rows.
        row_mask: (n,) bool, the rows that may be returned.
        k: Number of results.
        batcher: Batches the first-level scans of concurrent queries.
    """
    search = _Query(snapshot, query, row_mask, k, batcher)
    if not search.selected or not query.any():
        return search.to_response([], _ScoredRows(NO_ROWS, NO_SCORES, EXHAUSTIVE, 0))
    scored = search.score_rows()
    return search.to_response(search.rank_photos(scored), scored)


def sign_codes_pay_off(selected: int, k: int) -> bool:
    """Whether sign codes are faster than a dense scan of the selected rows.

    They leave about 2 k rows to compare exactly, and have a fixed cost of some dozens of rows.
    """
    return selected > 64 + 4 * k


@dataclass(frozen=True, eq=False)
class _Query:
    """A query of a snapshot, and the strategies that score its rows."""

    snapshot: Snapshot
    vector: QueryRow
    row_mask: NDArray[np.bool_]
    k: int
    batcher: QueryBatcher

    def score_rows(self) -> _ScoredRows:
        """Score the rows with the cheapest suitable strategy."""
        snapshot, selected = self.snapshot, self.selected
        if (
            snapshot.has_sign_codes
            and sign_codes_pay_off(selected, self.k)
            and (scored := self._search_by_sign_codes()) is not None
        ):
            return scored
        rows, scores = scan_top_k(snapshot, self.vector, self.k, self.row_mask)
        return _ScoredRows(rows, scores, EXHAUSTIVE, selected)

    def rank_photos(self, scored: _ScoredRows) -> list[SearchHit]:
        """Return the hits, sorted by descending score, ties by photo id."""
        k, rows, scores = self.k, scored.rows, round_scores(scored.scores)
        if len(rows) > k:
            kth = np.partition(scores, len(scores) - k)[len(scores) - k]
            best = scores >= kth
            rows, scores = rows[best], scores[best]
        ranked: list[tuple[float, UUID]] = sorted(
            (-score, photo_id)
            for score, photo_id in zip(scores.tolist(), self.snapshot.photos.ids(rows), strict=True)
            if photo_id is not None
        )
        return [SearchHit(photo_id=photo_id, score=-score) for score, photo_id in ranked[:k]]

    def to_response(self, hits: list[SearchHit], scored: _ScoredRows) -> SearchResponse:
        """Build the response; missing chunks may contain better rows."""
        missing = self.snapshot.missing
        return SearchResponse(
            hits=tuple(hits),
            certificate=NONE if missing else scored.certificate,
            rows_scanned=scored.scanned,
            rows_reranked=len(scored.rows),
            max_z=scored.max_z,
            snapshot_version=self.snapshot.version,
            missing=missing,
        )

    def _search_by_sign_codes(self) -> _ScoredRows | None:
        """Search by sign codes; None if an error of an estimate is larger than chance explains."""
        from services.search.sign_code_search import SignCodedQuery, SignCodeSearch
        from shared.codes.rotation import get_rotation

        blocks = self.snapshot.sign_code_blocks
        coded = SignCodedQuery.of(self.vector, get_rotation(len(self.vector)))
        first = self.batcher.scan(blocks, coded, self.row_mask)
        search = SignCodeSearch(blocks, coded, self.k, self.snapshot.prefetch_rows)
        result = search.search(first)
        if result.max_z > MAX_Z:
            return None
        return _ScoredRows(result.rows, result.scores, STATISTICAL, result.scanned, result.max_z)

    @cached_property
    def selected(self) -> int:
        """Number of rows that may be returned."""
        return int(np.count_nonzero(self.row_mask))


def round_scores(scores: Scores) -> Scores:
    """Round cosines, so that those of equal rows are equal."""
    # Clipped, because a computed cosine may exceed 1 slightly.
    return scores.round(SCORE_DECIMALS).clip(-1.0, 1.0)
