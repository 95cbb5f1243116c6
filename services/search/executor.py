"""One query on one snapshot: which way to search, and what can be said of the answer."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search import catalog_sync as follow
from services.search.dense_scan import QueryRow, exact_scores, scan_min_score, scan_top_k
from services.search.query_batcher import QueryBatcher
from services.search.snapshot import Snapshot
from shared.search_api.protocol import BOUND, EXHAUSTIVE, NONE, STATISTICAL, Mode, SearchHit

if TYPE_CHECKING:  # it leads to numba, which takes a while to load
    from services.search.exact_rerank import SearchBudget
    from services.search.int8_search import Candidates

log = logging.getLogger(__name__)

# One row in ten million is further off: then the codes are not trusted.
MAX_Z = 5.5

# Equal rows are equal however they were added up, and then the photos' ids decide.
SCORE_DECIMALS = 12

INT8_ROW_PARAMS_BYTES = 12  # scale, error and length, beside a code

RowNumbers = NDArray[np.int64]
Scores = NDArray[np.float64]

NO_ROWS = np.empty(0, np.int64)
NO_SCORES = np.empty(0)


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """The `k` most similar rows, of those that score at least `min_score`; and when to give up."""

    k: int
    min_score: float | None = None
    mode: Mode = Mode.AUTO
    most_rows: int | None = None
    most_seconds: float | None = None


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Hits in order, and how they were found, as `SearchResponse` tells it."""

    hits: tuple[SearchHit, ...]
    certificate: str
    certified_k: int
    rows_scanned: int
    rows_reranked: int
    max_z: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _ScoredRows:
    """Rows with their exact scores, among them all that the answer needs."""

    rows: RowNumbers
    scores: Scores
    certificate: str
    scanned: int
    max_z: float | None = None
    unseen_bound: float = -math.inf
    """What no other row exceeds."""


def execute_query(
    snapshot: Snapshot,
    query: QueryRow,
    row_mask: NDArray[np.bool_],
    options: SearchOptions,
    batcher: QueryBatcher,
) -> SearchResult:
    """Ask with a row, (dimension,) of any length, for the snapshot's rows of `row_mask`, (n,).

    A query of zeros is similar to nothing.
    """
    if not row_mask.any() or not query.any():
        return SearchResult((), EXHAUSTIVE, 0, 0, 0)
    found = _score_rows(snapshot, query, row_mask, options, batcher)
    hits = _rank_photos(snapshot, found.rows, found.scores, options)
    return _to_search_result(
        [SearchHit(photo_id=photo_id, score=score) for photo_id, _, score in hits], found
    )


def execute_weighted_query(
    snapshot: Snapshot,
    query: QueryRow,
    weighted_query: QueryRow,
    row_mask: NDArray[np.bool_],
    options: SearchOptions,
    batcher: QueryBatcher,
) -> SearchResult:
    """The same in the order of the scores with the `weighted_query` query, each with its plain
    cosine
    beside; `min_score` is of the plain one."""
    scanned = int(np.count_nonzero(row_mask))
    if options.min_score is not None and scanned:
        row_mask = _mask_min_score(snapshot, query, row_mask, options, batcher)
    if not row_mask.any():
        return SearchResult((), EXHAUSTIVE, 0, scanned, 0)
    found = _score_rows(
        snapshot, weighted_query, row_mask, replace(options, min_score=None), batcher
    )
    ranked = _rank_photos(snapshot, found.rows, found.scores, replace(options, min_score=None))
    plain = _round_scores(
        exact_scores(snapshot.chunks, query, np.array([row for _, row, _ in ranked]))
    )
    hits = [
        SearchHit(photo_id=photo_id, score=score, weighted_score=weighted_score)
        for (photo_id, _, weighted_score), score in zip(ranked, plain.tolist(), strict=True)
    ]
    return _to_search_result(hits, replace(found, scanned=scanned))


def sign_codes_pay_off(selected: int, k: int) -> bool:
    """Whether codes spare anything: they leave about twice k rows to compare, and cost as much as
    some dozens."""
    return selected > 64 + 4 * k


def _score_rows(
    snapshot: Snapshot,
    query: QueryRow,
    asked: NDArray[np.bool_],
    question: SearchOptions,
    glances: QueryBatcher,
) -> _ScoredRows:
    selected = int(np.count_nonzero(asked))
    found = None
    if question.mode != Mode.DENSE and sign_codes_pay_off(selected, question.k):
        found = _search_on_gpu(snapshot, query, asked, question)
        if found is None and question.mode == Mode.AUTO and snapshot.has_sign_codes:
            found = _search_by_sign_codes(snapshot, query, asked, question, glances)
    if found is None and _uses_int8_codes(snapshot, question.mode, selected, question.k):
        found = _search_by_int8(snapshot, query, asked, question)
    if found is None:
        rows, scores = scan_top_k(snapshot.chunks, query, question.k, asked)
        found = _ScoredRows(rows, scores, EXHAUSTIVE, selected)
    return found


def _uses_int8_codes(snapshot: Snapshot, mode: Mode, selected: int, k: int) -> bool:
    """Whether int8 codes are there, wanted, and spare anything."""
    wanted = mode == Mode.DETERMINISTIC or (mode == Mode.AUTO and not snapshot.has_sign_codes)
    return (
        wanted and snapshot.has_int8_codes and int8_codes_pay_off(selected, k, snapshot.dimension)
    )


def _mask_min_score(
    snapshot: Snapshot,
    query: QueryRow,
    asked: NDArray[np.bool_],
    question: SearchOptions,
    glances: QueryBatcher,
) -> NDArray[np.bool_]:
    """Of the rows that are asked for, those that score at least `min_score`."""
    assert question.min_score is not None
    found = None
    if question.mode == Mode.AUTO and snapshot.has_sign_codes and sign_codes_pay_off(len(asked), 1):
        everything = SearchOptions(len(asked), question.min_score)
        found = _search_by_sign_codes(snapshot, query, asked, everything, glances)
    if found is not None:
        rows, scores = found.rows, found.scores
    else:
        rows, scores = scan_min_score(snapshot.chunks, query, question.min_score, asked)
    passing = np.zeros(len(asked), bool)
    passing[rows[_round_scores(scores) >= question.min_score]] = True
    return passing


def int8_codes_pay_off(selected: int, k: int, dimension: int) -> bool:
    """Whether int8 codes, and about twice k rows to compare, are less to read than all rows."""
    from shared.codes.rotation import get_rotation

    row_bytes = 4 * dimension
    code_bytes = get_rotation(dimension).padded + INT8_ROW_PARAMS_BYTES
    return selected * code_bytes + (2 * k + 16) * row_bytes < selected * row_bytes


def needs_int8_codes(snapshot: Snapshot, row_mask: NDArray[np.bool_], k: int) -> bool:
    """Whether a search that leaves nothing to chance has to read every row, for want of codes."""
    if (
        snapshot.has_int8_codes
        or snapshot.gpu_snapshot
        or snapshot.row_bytes < follow.MIN_CODED_BYTES
    ):
        return False
    if not snapshot.chunks:
        return False
    return int8_codes_pay_off(int(np.count_nonzero(row_mask)), k, snapshot.dimension)


def _search_on_gpu(
    snapshot: Snapshot, query: QueryRow, asked: NDArray[np.bool_], question: SearchOptions
) -> _ScoredRows | None:
    """None where the snapshot lies on no GPU, or that fails."""
    resident = snapshot.gpu_snapshot
    if resident is None or resident.failure is not None:
        return None
    from services.search.gpu import GpuError, GpuQuery

    budget = _search_budget(question)
    try:
        (near,) = resident.candidates([GpuQuery(query, asked, question.k, _score_floor(question))])
    except GpuError as error:
        log.error("generation %s is searched by the CPU: %s", snapshot.generation_id, error)
        return None
    return _rerank_candidates(snapshot, query, near, asked, question, budget)


def _search_by_int8(
    snapshot: Snapshot, query: QueryRow, asked: NDArray[np.bool_], question: SearchOptions
) -> _ScoredRows:
    from services.search.int8_search import find_candidates
    from shared.codes.int8_codes import Int8Query

    budget = _search_budget(question)
    coded = Int8Query.from_row(query)
    near = find_candidates(
        snapshot.int8_blocks, coded, asked, question.k, _score_floor(question), budget
    )
    if near is None:
        return _ScoredRows(
            NO_ROWS, NO_SCORES, NONE, int(np.count_nonzero(asked)), unseen_bound=math.inf
        )
    return _rerank_candidates(snapshot, query, near, asked, question, budget)


def _rerank_candidates(
    snapshot: Snapshot,
    query: QueryRow,
    near: Candidates,
    asked: NDArray[np.bool_],
    question: SearchOptions,
    budget: SearchBudget,
) -> _ScoredRows:
    """Compare what may be among the best exactly."""
    from services.search.exact_rerank import ExactReranker

    norm = float(np.linalg.norm(query.astype(np.float64)))
    rerank = ExactReranker(snapshot.row_blocks, query, norm, question.k, snapshot.prefetch_rows)
    found = rerank.find_best(near.rows, near.upper_bounds, near.floor, budget)
    certificate = BOUND if found.is_complete else NONE
    scanned = int(np.count_nonzero(asked))
    return _ScoredRows(
        found.rows, found.scores, certificate, scanned, unseen_bound=found.unseen_bound
    )


def _score_floor(question: SearchOptions) -> float:
    return -math.inf if question.min_score is None else question.min_score


def _search_budget(question: SearchOptions) -> SearchBudget:
    from services.search.exact_rerank import SearchBudget

    until = question.most_seconds and time.monotonic() + question.most_seconds
    return SearchBudget(question.most_rows, until)


def _search_by_sign_codes(
    snapshot: Snapshot,
    query: QueryRow,
    asked: NDArray[np.bool_],
    question: SearchOptions,
    glances: QueryBatcher,
) -> _ScoredRows | None:
    """None when an estimate was further off than chance explains."""
    from services.search.sign_code_search import SignCodedQuery, SignCodeSearch
    from shared.codes.rotation import get_rotation

    budget = _search_budget(question)
    coded = SignCodedQuery.of(query, get_rotation(len(query)))
    first = glances.scan(snapshot.sign_code_blocks, coded, asked)
    refinement = SignCodeSearch(
        snapshot.sign_code_blocks, coded, question.k, question.min_score, snapshot.prefetch_rows
    )
    found = refinement.search(first, budget)
    if found.max_z > MAX_Z:
        return None
    certificate = STATISTICAL if found.is_complete else NONE
    return _ScoredRows(
        found.rows, found.scores, certificate, found.scanned, found.max_z, found.unseen_bound
    )


def _rank_photos(
    snapshot: Snapshot, rows: RowNumbers, scores: Scores, question: SearchOptions
) -> list[tuple[UUID, int, float]]:
    """(photo, row, score), highest score first, ties by photo id."""
    scores = _round_scores(scores)
    if question.min_score is not None:
        enough = scores >= question.min_score
        rows, scores = rows[enough], scores[enough]
    if len(rows) > question.k:
        kth = np.partition(scores, len(scores) - question.k)[len(scores) - question.k]
        best = scores >= kth
        rows, scores = rows[best], scores[best]
    ranked: list[tuple[float, UUID, int]] = sorted(
        (-score, photo_id, row)
        for score, photo_id, row in zip(
            scores.tolist(), snapshot.photos.ids(rows), rows.tolist(), strict=True
        )
        if photo_id is not None
    )
    return [(photo_id, row, -score) for score, photo_id, row in ranked[: question.k]]


def _to_search_result(hits: list[SearchHit], found: _ScoredRows) -> SearchResult:
    return SearchResult(
        hits=tuple(hits),
        certificate=found.certificate,
        certified_k=sum(hit.ranked_by > found.unseen_bound for hit in hits),
        rows_scanned=found.scanned,
        rows_reranked=len(found.rows),
        max_z=found.max_z,
    )


def _round_scores(scores: Scores) -> Scores:
    # Rounding may not turn a cosine into 1.0000001, either.
    return np.clip(np.round(scores, SCORE_DECIMALS), -1.0, 1.0)
