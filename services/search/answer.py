"""One query on one snapshot: which way to search, and what can be said of the answer."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.search.scan import Query, exact_scores, scan, scan_at_least
from services.search.snapshot import Snapshot
from services.search.together import Glances
from shared.search_protocol import EXHAUSTIVE, NONE, STATISTICAL, Hit, Mode

# One row in ten million is further off: then the codes are not trusted.
MOST_Z = 5.5

# Equal rows are equal however they were added up, and then the photos' ids decide.
DECIMALS = 12


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
    by_codes = question.mode == Mode.AUTO and worth_codes(selected, question.k)
    if by_codes and snapshot.coded:
        found = _by_codes(snapshot, query, asked, question, glances)
        if found is not None:
            return found
    rows, scores = scan(snapshot.chunks, query, question.k, asked)
    return _Compared(rows, scores, EXHAUSTIVE, selected)


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


def _by_codes(
    snapshot: Snapshot,
    query: Query,
    asked: NDArray[np.bool_],
    question: Question,
    glances: Glances,
) -> _Compared | None:
    """None when an estimate was further off than chance explains."""
    from services.search.cascade import Budget, CodedQuery, Refinement
    from shared.codes.rotation import rotation

    until = question.most_seconds and time.monotonic() + question.most_seconds
    coded = CodedQuery.of(query, rotation(len(query)))
    first = glances.glance(snapshot.blocks, coded, asked)
    refinement = Refinement(
        snapshot.blocks, coded, question.k, question.min_score, snapshot.read_ahead
    )
    found = refinement.search(first, Budget(question.most_rows, until))
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
