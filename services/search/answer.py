"""One query on one snapshot: which way to search, and what can be said of the answer."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search import follow
from services.search.scan import scan
from services.search.snapshot import Snapshot
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


def answer(
    snapshot: Snapshot,
    query: NDArray[np.float32],
    asked: NDArray[np.bool_],
    question: Question,
) -> Answer:
    """Ask with a row, (dimension,) float32 of any length, for the snapshot's rows of `asked`, (n,).

    A query of zeros is similar to nothing.
    """
    selected = int(np.count_nonzero(asked))
    if not selected or not query.any():
        return Answer((), EXHAUSTIVE, 0, 0, 0)
    if question.mode != Mode.DENSE and worth_codes(selected, question.k):
        found = _on_device(snapshot, query, asked, question)
        if found is not None:
            return found
    if question.mode == Mode.AUTO and snapshot.coded:
        if worth_codes(selected, question.k):
            found = _by_codes(snapshot, query, asked, question)
            if found is not None:
                return found
    elif (
        question.mode != Mode.DENSE
        and snapshot.bounded
        and worth_int8(selected, question.k, len(query))
    ):
        return _by_bound(snapshot, query, asked, question)
    rows, scores = scan(snapshot.chunks, query, question.k, asked)
    hits = _ranked(snapshot, rows, scores, question)
    return Answer(hits, EXHAUSTIVE, len(hits), selected, len(rows))


def worth_codes(selected: int, k: int) -> bool:
    """Whether codes spare anything: they leave about twice k rows to compare, and cost as much as
    some dozens."""
    return selected > 64 + 4 * k


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
    return worth_int8(int(np.count_nonzero(asked)), k, snapshot.chunks[0].rows.shape[1])


def _on_device(
    snapshot: Snapshot, query: NDArray[np.float32], asked: NDArray[np.bool_], question: Question
) -> Answer | None:
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
    snapshot: Snapshot, query: NDArray[np.float32], asked: NDArray[np.bool_], question: Question
) -> Answer:
    from services.search.bounded import candidates
    from shared.codes.int8 import Int8Query

    budget = _budget(question)
    coded = Int8Query.of(query)
    near = candidates(snapshot.int8_blocks, coded, asked, question.k, _least(question), budget)
    if near is None:
        return Answer((), NONE, 0, int(np.count_nonzero(asked)), 0)
    return _settled(snapshot, query, near, asked, question, budget)


def _settled(
    snapshot: Snapshot,
    query: NDArray[np.float32],
    near: Candidates,
    asked: NDArray[np.bool_],
    question: Question,
    budget: Budget,
) -> Answer:
    """Compare what may be among the best exactly."""
    from services.search.rerank import Rerank

    norm = float(np.linalg.norm(query.astype(np.float64)))
    rerank = Rerank(snapshot.row_blocks, query, norm, question.k, snapshot.read_ahead)
    found = rerank.best(near.rows, near.reach, near.floor, budget)
    hits = _ranked(snapshot, found.rows, found.scores, question)
    certified = sum(hit.score > found.unseen for hit in hits)
    scanned = int(np.count_nonzero(asked))
    return Answer(hits, BOUND if found.whole else NONE, certified, scanned, len(found.rows))


def _least(question: Question) -> float:
    return -math.inf if question.min_score is None else question.min_score


def _budget(question: Question) -> Budget:
    from services.search.rerank import Budget

    until = question.most_seconds and time.monotonic() + question.most_seconds
    return Budget(question.most_rows, until)


def _by_codes(
    snapshot: Snapshot, query: NDArray[np.float32], asked: NDArray[np.bool_], question: Question
) -> Answer | None:
    """None when an estimate was further off than chance explains."""
    from services.search.cascade import CodedQuery, Refinement, glance
    from shared.codes.rotation import rotation

    budget = _budget(question)
    coded = CodedQuery.of(query, rotation(len(query)))
    first = glance(snapshot.blocks, coded, asked)
    refinement = Refinement(
        snapshot.blocks, coded, question.k, question.min_score, snapshot.read_ahead
    )
    found = refinement.search(first, budget)
    if found.max_z > MOST_Z:
        return None
    hits = _ranked(snapshot, found.rows, found.scores, question)
    certified = sum(hit.score > found.unseen for hit in hits)
    return Answer(
        hits,
        STATISTICAL if found.whole else NONE,
        certified,
        found.scanned,
        len(found.rows),
        found.max_z,
    )


def _ranked(snapshot: Snapshot, rows: Rows, scores: Scores, question: Question) -> tuple[Hit, ...]:
    """By score, highest first, ties by photo id."""
    scores = np.clip(np.round(scores, DECIMALS), -1.0, 1.0)
    if question.min_score is not None:
        enough = scores >= question.min_score
        rows, scores = rows[enough], scores[enough]
    if len(rows) > question.k:
        kth = np.partition(scores, len(scores) - question.k)[len(scores) - question.k]
        best = scores >= kth
        rows, scores = rows[best], scores[best]
    ranked: list[tuple[float, UUID]] = sorted(
        (-score, photo_id)
        for score, photo_id in zip(scores.tolist(), snapshot.photos.ids(rows), strict=True)
        if photo_id is not None
    )
    return tuple(Hit(photo_id=photo_id, score=-score) for score, photo_id in ranked[: question.k])
