"""Query executor: runs a query on a snapshot with the cheapest suitable search strategy.

The strategies are the dense scan, sign codes, int8 codes and the GPU. All compare the best
candidates exactly and rank by float64 cosines; they differ in the certificate of the result.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.dense_scan import QueryRow, exact_scores, scan_min_score, scan_top_k
from services.search.query_batcher import QueryBatcher
from services.search.snapshot import Snapshot
from shared.search_api.protocol import BOUND, EXHAUSTIVE, NONE, STATISTICAL, Mode, SearchHit

if TYPE_CHECKING:  # imports numba, which takes a while to load
    from services.search.exact_rerank import SearchBudget
    from services.search.int8_search import Candidates

log = logging.getLogger(__name__)

# Largest plausible error in standard deviations (exceeded by one row in ten million); beyond it
# the sign codes are not trusted.
MAX_Z = 5.5

# Rounding makes equal rows have equal scores whatever the summation order; ties go by photo id.
SCORE_DECIMALS = 12

INT8_ROW_PARAMS_BYTES = 12  # scale, error and length of a code

RowNumbers = NDArray[np.int64]
Scores = NDArray[np.float64]

NO_ROWS = np.empty(0, np.int64)
NO_SCORES = np.empty(0)


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """Number of results, minimum score, strategy, and limits of a search.

    Attributes:
        k: Number of results.
        min_score: Minimum cosine; None for no minimum.
        mode: Search strategy.
        most_rows: Maximum number of rows compared exactly.
        most_seconds: Time limit in seconds.
    """

    k: int
    min_score: float | None = None
    mode: Mode = Mode.AUTO
    most_rows: int | None = None
    most_seconds: float | None = None


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Hits in order, with the statistics of `SearchResponse`."""

    hits: tuple[SearchHit, ...]
    certificate: str
    certified_k: int
    rows_scanned: int
    rows_reranked: int
    max_z: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _ScoredRows:
    """Rows with their exact scores, among them all that the result needs."""

    rows: RowNumbers
    scores: Scores
    certificate: str
    scanned: int
    max_z: float | None = None
    unseen_bound: float = -math.inf
    """Upper bound of the scores of all other rows."""


def execute_query(
    snapshot: Snapshot,
    query: QueryRow,
    row_mask: NDArray[np.bool_],
    options: SearchOptions,
    batcher: QueryBatcher,
) -> SearchResult:
    """Search the rows of a snapshot that are most similar to a query.

    Args:
        snapshot: The snapshot.
        query: (dimension,) row of any length; a row of zeros has no similar rows.
        row_mask: (n,) bool, the rows that may be returned.
        options: Number of results, minimum score, strategy and limits.
        batcher: Batches the first-level scans of concurrent queries.
    """
    if not row_mask.any() or not query.any():
        return SearchResult((), EXHAUSTIVE, 0, 0, 0)
    scored = _score_rows(snapshot, query, row_mask, options, batcher)
    hits = _rank_photos(snapshot, scored.rows, scored.scores, options)
    return _to_search_result(
        [SearchHit(photo_id=photo_id, score=score) for photo_id, _, score in hits], scored
    )


def execute_weighted_query(
    snapshot: Snapshot,
    query: QueryRow,
    weighted_query: QueryRow,
    row_mask: NDArray[np.bool_],
    options: SearchOptions,
    batcher: QueryBatcher,
) -> SearchResult:
    """Rank rows by their similarity to `weighted_query`; hits also carry the plain cosine.

    `options.min_score` applies to the plain cosine, with `query`. See `execute_query`.
    """
    scanned = int(np.count_nonzero(row_mask))
    if options.min_score is not None and scanned:
        row_mask = _mask_min_score(snapshot, query, row_mask, options, batcher)
    if not row_mask.any():
        return SearchResult((), EXHAUSTIVE, 0, scanned, 0)
    scored = _score_rows(
        snapshot, weighted_query, row_mask, replace(options, min_score=None), batcher
    )
    ranked = _rank_photos(snapshot, scored.rows, scored.scores, replace(options, min_score=None))
    plain_scores = _round_scores(
        exact_scores(snapshot.chunks, query, np.array([row for _, row, _ in ranked]))
    )
    hits = [
        SearchHit(photo_id=photo_id, score=score, weighted_score=weighted_score)
        for (photo_id, _, weighted_score), score in zip(ranked, plain_scores.tolist(), strict=True)
    ]
    return _to_search_result(hits, replace(scored, scanned=scanned))


def sign_codes_pay_off(selected: int, k: int) -> bool:
    """Whether sign codes are faster than a dense scan of the selected rows.

    They leave about 2 k rows to compare exactly, and have a fixed cost of some dozens of rows.
    """
    return selected > 64 + 4 * k


def _score_rows(
    snapshot: Snapshot,
    query: QueryRow,
    row_mask: NDArray[np.bool_],
    options: SearchOptions,
    batcher: QueryBatcher,
) -> _ScoredRows:
    selected = int(np.count_nonzero(row_mask))
    scored = None
    if options.mode != Mode.DENSE and sign_codes_pay_off(selected, options.k):
        scored = _search_on_gpu(snapshot, query, row_mask, options)
        if scored is None and options.mode == Mode.AUTO and snapshot.has_sign_codes:
            scored = _search_by_sign_codes(snapshot, query, row_mask, options, batcher)
    if (
        scored is None
        and options.mode != Mode.DENSE
        and snapshot.has_int8_codes
        and int8_codes_pay_off(selected, options.k, snapshot.dimension)
    ):
        scored = _search_by_int8(snapshot, query, row_mask, options)
    if scored is None:
        rows, scores = scan_top_k(snapshot.chunks, query, options.k, row_mask)
        scored = _ScoredRows(rows, scores, EXHAUSTIVE, selected)
    return scored


def _mask_min_score(
    snapshot: Snapshot,
    query: QueryRow,
    row_mask: NDArray[np.bool_],
    options: SearchOptions,
    batcher: QueryBatcher,
) -> NDArray[np.bool_]:
    """Return the rows of the mask that score at least `options.min_score`."""
    assert options.min_score is not None
    scored = None
    if (
        options.mode == Mode.AUTO
        and snapshot.has_sign_codes
        and sign_codes_pay_off(len(row_mask), 1)
    ):
        all_rows = SearchOptions(len(row_mask), options.min_score)
        scored = _search_by_sign_codes(snapshot, query, row_mask, all_rows, batcher)
    if scored is not None:
        rows, scores = scored.rows, scored.scores
    else:
        rows, scores = scan_min_score(snapshot.chunks, query, options.min_score, row_mask)
    passing = np.zeros(len(row_mask), bool)
    passing[rows[_round_scores(scores) >= options.min_score]] = True
    return passing


def int8_codes_pay_off(selected: int, k: int, dimension: int) -> bool:
    """Whether a search by int8 codes reads fewer bytes than a dense scan of the selected rows.

    It reads all codes and about 2 k full rows.
    """
    from shared.codes.rotation import get_rotation

    row_bytes = 4 * dimension
    code_bytes = get_rotation(dimension).padded + INT8_ROW_PARAMS_BYTES
    return selected * code_bytes + (2 * k + 16) * row_bytes < selected * row_bytes


def _search_on_gpu(
    snapshot: Snapshot, query: QueryRow, row_mask: NDArray[np.bool_], options: SearchOptions
) -> _ScoredRows | None:
    """Search on the GPU; None if the snapshot is not loaded there, or the GPU fails."""
    resident = snapshot.gpu_snapshot
    if resident is None or resident.failure is not None:
        return None
    from services.search.gpu import GpuError, GpuQuery

    budget = _search_budget(options)
    try:
        (candidates,) = resident.candidates(
            [GpuQuery(query, row_mask, options.k, _score_floor(options))]
        )
    except GpuError as error:
        log.error("generation %s is searched by the CPU: %s", snapshot.generation_id, error)
        return None
    return _rerank_candidates(snapshot, query, candidates, row_mask, options, budget)


def _search_by_int8(
    snapshot: Snapshot, query: QueryRow, row_mask: NDArray[np.bool_], options: SearchOptions
) -> _ScoredRows:
    from services.search.int8_search import find_candidates
    from shared.codes.int8_codes import Int8Query

    budget = _search_budget(options)
    coded = Int8Query.from_row(query)
    candidates = find_candidates(
        snapshot.int8_blocks, coded, row_mask, options.k, _score_floor(options), budget
    )
    if candidates is None:
        return _ScoredRows(
            NO_ROWS, NO_SCORES, NONE, int(np.count_nonzero(row_mask)), unseen_bound=math.inf
        )
    return _rerank_candidates(snapshot, query, candidates, row_mask, options, budget)


def _rerank_candidates(
    snapshot: Snapshot,
    query: QueryRow,
    candidates: Candidates,
    row_mask: NDArray[np.bool_],
    options: SearchOptions,
    budget: SearchBudget,
) -> _ScoredRows:
    """Compare the candidates exactly."""
    from services.search.exact_rerank import ExactReranker

    norm = float(np.linalg.norm(query.astype(np.float64)))
    reranker = ExactReranker(snapshot.row_blocks, query, norm, options.k, snapshot.prefetch_rows)
    reranked = reranker.find_best(
        candidates.rows, candidates.upper_bounds, candidates.floor, budget
    )
    certificate = BOUND if reranked.is_complete else NONE
    scanned = int(np.count_nonzero(row_mask))
    return _ScoredRows(
        reranked.rows, reranked.scores, certificate, scanned, unseen_bound=reranked.unseen_bound
    )


def _score_floor(options: SearchOptions) -> float:
    return -math.inf if options.min_score is None else options.min_score


def _search_budget(options: SearchOptions) -> SearchBudget:
    from services.search.exact_rerank import SearchBudget

    deadline = options.most_seconds and time.monotonic() + options.most_seconds
    return SearchBudget(options.most_rows, deadline)


def _search_by_sign_codes(
    snapshot: Snapshot,
    query: QueryRow,
    row_mask: NDArray[np.bool_],
    options: SearchOptions,
    batcher: QueryBatcher,
) -> _ScoredRows | None:
    """Search by sign codes; None if an error of an estimate is larger than chance explains."""
    from services.search.sign_code_search import SignCodedQuery, SignCodeSearch
    from shared.codes.rotation import get_rotation

    budget = _search_budget(options)
    coded = SignCodedQuery.of(query, get_rotation(len(query)))
    first = batcher.scan(snapshot.sign_code_blocks, coded, row_mask)
    search = SignCodeSearch(
        snapshot.sign_code_blocks, coded, options.k, options.min_score, snapshot.prefetch_rows
    )
    result = search.search(first, budget)
    if result.max_z > MAX_Z:
        return None
    certificate = STATISTICAL if result.is_complete else NONE
    return _ScoredRows(
        result.rows, result.scores, certificate, result.scanned, result.max_z, result.unseen_bound
    )


def _rank_photos(
    snapshot: Snapshot, rows: RowNumbers, scores: Scores, options: SearchOptions
) -> list[tuple[UUID, int, float]]:
    """Return (photo, row, score), sorted by descending score, ties by photo id."""
    scores = _round_scores(scores)
    if options.min_score is not None:
        passing = scores >= options.min_score
        rows, scores = rows[passing], scores[passing]
    if len(rows) > options.k:
        kth = np.partition(scores, len(scores) - options.k)[len(scores) - options.k]
        best = scores >= kth
        rows, scores = rows[best], scores[best]
    ranked: list[tuple[float, UUID, int]] = sorted(
        (-score, photo_id, row)
        for score, photo_id, row in zip(
            scores.tolist(), snapshot.photos.ids(rows), rows.tolist(), strict=True
        )
        if photo_id is not None
    )
    return [(photo_id, row, -score) for score, photo_id, row in ranked[: options.k]]


def _to_search_result(hits: list[SearchHit], scored: _ScoredRows) -> SearchResult:
    return SearchResult(
        hits=tuple(hits),
        certificate=scored.certificate,
        certified_k=sum(hit.ranked_by > scored.unseen_bound for hit in hits),
        rows_scanned=scored.scanned,
        rows_reranked=len(scored.rows),
        max_z=scored.max_z,
    )


def _round_scores(scores: Scores) -> Scores:
    # Clipped, because a computed cosine may exceed 1 slightly.
    return np.clip(np.round(scores, SCORE_DECIMALS), -1.0, 1.0)
