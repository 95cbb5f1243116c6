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

from services.search import follow
from services.search.scan import Query, exact_scores, scan, scan_at_least
from services.search.snapshot import Snapshot
from services.search.together import Glances
from shared.search_protocol import BOUND, EXHAUSTIVE, NONE, STATISTICAL, Hit, Mode

if TYPE_CHECKING:  # it leads to numba, which takes a while to load
    from services.search.bounded import Candidates
    from services.search.rerank import Budget

log = logging.getLogger(__name__)

# One row in ten million is further off: then the codes are not trusted.
MOST_Z = 5.5

# Equal rows are equal however they were added up, and then the photos' ids decide.
DECIMALS = 12

INT8_FIGURES_BYTES = 12  # scale, error and length, beside a code

Rows = NDArray[np.int64]
Scores = NDArray[np.float64]

NO_ROWS = np.empty(0, np.int64)
NO_SCORES = np.empty(0)


@dataclass(frozen=True, slots=True)
class Question:
    """The `k` most similar rows, of those that score at least `min_score`; and when to give up."""

    k: int
    min_score: float | None = None
    mode: Mode = Mode.AUTO
    most_rows: int | None = None
    most_seconds: float | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """Hits in order, and how they were found, as `SearchResponse` tells it."""

    hits: tuple[Hit, ...]
    certificate: str
    certified_k: int
    rows_scanned: int
    rows_reranked: int
    max_z: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """Rows with their exact scores, among them all that the answer needs."""

    rows: Rows
    scores: Scores
    certificate: str
    scanned: int
    max_z: float | None = None
    unseen: float = -math.inf
    """What no other row exceeds."""


def answer(
    snapshot: Snapshot,
    query: Query,
    asked: NDArray[np.bool_],
    question: Question,
    glances: Glances,
) -> Answer:
    """Ask with a row, (dimension,) of any length, for the snapshot's rows of `asked`, (n,).

    A query of zeros is similar to nothing.
    """
    if not asked.any() or not query.any():
        return Answer((), EXHAUSTIVE, 0, 0, 0)
    found = _compare(snapshot, query, asked, question, glances)
    hits = _ranked(snapshot, found.rows, found.scores, question)
    return _answer([Hit(photo_id=photo_id, score=score) for photo_id, _, score in hits], found)


def weighted_answer(
    snapshot: Snapshot,
    query: Query,
    weighted: Query,
    asked: NDArray[np.bool_],
    question: Question,
    glances: Glances,
) -> Answer:
    """The same in the order of the scores with the `weighted` query, each with its plain cosine
    beside; `min_score` is of the plain one."""
    scanned = int(np.count_nonzero(asked))
    if question.min_score is not None and scanned:
        asked = _at_least(snapshot, query, asked, question, glances)
    if not asked.any():
        return Answer((), EXHAUSTIVE, 0, scanned, 0)
    found = _compare(snapshot, weighted, asked, replace(question, min_score=None), glances)
    ranked = _ranked(snapshot, found.rows, found.scores, replace(question, min_score=None))
    plain = _rounded(exact_scores(snapshot.chunks, query, np.array([row for _, row, _ in ranked])))
    hits = [
        Hit(photo_id=photo_id, score=score, weighted_score=weighted_score)
        for (photo_id, _, weighted_score), score in zip(ranked, plain.tolist(), strict=True)
    ]
    return _answer(hits, replace(found, scanned=scanned))


def worth_codes(selected: int, k: int) -> bool:
    """Whether codes spare anything: they leave about twice k rows to compare, and cost as much as
    some dozens."""
    return selected > 64 + 4 * k


def _compare(
    snapshot: Snapshot,
    query: Query,
    asked: NDArray[np.bool_],
    question: Question,
    glances: Glances,
) -> _Compared:
    selected = int(np.count_nonzero(asked))
    found = None
    if question.mode != Mode.DENSE and worth_codes(selected, question.k):
        found = _on_device(snapshot, query, asked, question)
        if found is None and question.mode == Mode.AUTO and snapshot.coded:
            found = _by_codes(snapshot, query, asked, question, glances)
    if found is None and _bounded(snapshot, question.mode, selected, question.k):
        found = _by_bound(snapshot, query, asked, question)
    if found is None:
        rows, scores = scan(snapshot.chunks, query, question.k, asked)
        found = _Compared(rows, scores, EXHAUSTIVE, selected)
    return found


def _bounded(snapshot: Snapshot, mode: Mode, selected: int, k: int) -> bool:
    """Whether int8 codes are there, wanted, and spare anything."""
    wanted = mode == Mode.DETERMINISTIC or (mode == Mode.AUTO and not snapshot.coded)
    return wanted and snapshot.bounded and worth_int8(selected, k, snapshot.dimension)


def _at_least(
    snapshot: Snapshot,
    query: Query,
    asked: NDArray[np.bool_],
    question: Question,
    glances: Glances,
) -> NDArray[np.bool_]:
    """Of the rows that are asked for, those that score at least `min_score`."""
    assert question.min_score is not None
    found = None
    if question.mode == Mode.AUTO and snapshot.coded and worth_codes(len(asked), 1):
        everything = Question(len(asked), question.min_score)
        found = _by_codes(snapshot, query, asked, everything, glances)
    if found is not None:
        rows, scores = found.rows, found.scores
    else:
        rows, scores = scan_at_least(snapshot.chunks, query, question.min_score, asked)
    passing = np.zeros(len(asked), bool)
    passing[rows[_rounded(scores) >= question.min_score]] = True
    return passing


def worth_int8(selected: int, k: int, dimension: int) -> bool:
    """Whether int8 codes, and about twice k rows to compare, are less to read than all rows."""
    from shared.codes.rotation import rotation

    row_bytes = 4 * dimension
    code_bytes = rotation(dimension).padded + INT8_FIGURES_BYTES
    return selected * code_bytes + (2 * k + 16) * row_bytes < selected * row_bytes


def lacks_int8(snapshot: Snapshot, asked: NDArray[np.bool_], k: int) -> bool:
    """Whether a search that leaves nothing to chance has to read every row, for want of codes."""
    if snapshot.bounded or snapshot.resident or snapshot.row_bytes < follow.CODED_FROM_BYTES:
        return False
    if not snapshot.chunks:
        return False
    return worth_int8(int(np.count_nonzero(asked)), k, snapshot.dimension)


def _on_device(
    snapshot: Snapshot, query: Query, asked: NDArray[np.bool_], question: Question
) -> _Compared | None:
    """None where the snapshot lies on no GPU, or that fails."""
    resident = snapshot.resident
    if resident is None or resident.failure is not None:
        return None
    from services.search.gpu import Asked, DeviceFailed

    budget = _budget(question)
    try:
        (near,) = resident.candidates([Asked(query, asked, question.k, _least(question))])
    except DeviceFailed as error:
        log.error("generation %s is searched by the CPU: %s", snapshot.generation_id, error)
        return None
    return _settled(snapshot, query, near, asked, question, budget)


def _by_bound(
    snapshot: Snapshot, query: Query, asked: NDArray[np.bool_], question: Question
) -> _Compared:
    from services.search.bounded import candidates
    from shared.codes.int8 import Int8Query

    budget = _budget(question)
    coded = Int8Query.of(query)
    near = candidates(snapshot.int8_blocks, coded, asked, question.k, _least(question), budget)
    if near is None:
        return _Compared(NO_ROWS, NO_SCORES, NONE, int(np.count_nonzero(asked)), unseen=math.inf)
    return _settled(snapshot, query, near, asked, question, budget)


def _settled(
    snapshot: Snapshot,
    query: Query,
    near: Candidates,
    asked: NDArray[np.bool_],
    question: Question,
    budget: Budget,
) -> _Compared:
    """Compare what may be among the best exactly."""
    from services.search.rerank import Rerank

    norm = float(np.linalg.norm(query.astype(np.float64)))
    rerank = Rerank(snapshot.row_blocks, query, norm, question.k, snapshot.read_ahead)
    found = rerank.best(near.rows, near.reach, near.floor, budget)
    certificate = BOUND if found.whole else NONE
    scanned = int(np.count_nonzero(asked))
    return _Compared(found.rows, found.scores, certificate, scanned, unseen=found.unseen)


def _least(question: Question) -> float:
    return -math.inf if question.min_score is None else question.min_score


def _budget(question: Question) -> Budget:
    from services.search.rerank import Budget

    until = question.most_seconds and time.monotonic() + question.most_seconds
    return Budget(question.most_rows, until)


def _by_codes(
    snapshot: Snapshot,
    query: Query,
    asked: NDArray[np.bool_],
    question: Question,
    glances: Glances,
) -> _Compared | None:
    """None when an estimate was further off than chance explains."""
    from services.search.cascade import CodedQuery, Refinement
    from shared.codes.rotation import rotation

    budget = _budget(question)
    coded = CodedQuery.of(query, rotation(len(query)))
    first = glances.glance(snapshot.blocks, coded, asked)
    refinement = Refinement(
        snapshot.blocks, coded, question.k, question.min_score, snapshot.read_ahead
    )
    found = refinement.search(first, budget)
    if found.max_z > MOST_Z:
        return None
    certificate = STATISTICAL if found.whole else NONE
    return _Compared(
        found.rows, found.scores, certificate, found.scanned, found.max_z, found.unseen
    )


def _ranked(
    snapshot: Snapshot, rows: Rows, scores: Scores, question: Question
) -> list[tuple[UUID, int, float]]:
    """(photo, row, score), highest score first, ties by photo id."""
    scores = _rounded(scores)
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


def _answer(hits: list[Hit], found: _Compared) -> Answer:
    return Answer(
        hits=tuple(hits),
        certificate=found.certificate,
        certified_k=sum(hit.ranked_by > found.unseen for hit in hits),
        rows_scanned=found.scanned,
        rows_reranked=len(found.rows),
        max_z=found.max_z,
    )


def _rounded(scores: Scores) -> Scores:
    # Rounding may not turn a cosine into 1.0000001, either.
    return np.clip(np.round(scores, DECIMALS), -1.0, 1.0)
