"""Retrieval grids of a report, and the section that compares it with another run.

A grid has a row per query: the query framed in blue, then its first matches, framed in green if
they are correct and in red if not.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from lab.datasets.open_dataset import DatasetPhoto
from lab.evaluation.results import EvaluationResult, RunComparison
from shared.errors import Unprocessable
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import get_preprocessing

COLUMNS_SHOWN = 5  # database photos per row
MAX_NAME_CHARACTERS = 34
MAX_PIXELS = 200_000_000
_THUMBNAIL_PREPROCESSING = get_preprocessing("square32")  # only the decoder's thumbnail is used


def retrieval_grids(
    result: EvaluationResult, max_rows: int, *, only_wrong: bool
) -> list[tuple[str, str]]:
    """Render the grids of wrong, unfindable and correct queries.

    Wrong queries are sorted by descending score of the first match, correct ones by ascending
    score.

    Returns:
        (heading, HTML table) of each grid that has rows.
    """
    is_correct = result.measured.hits[:, 0]
    findable = np.array([len(rows) > 0 for rows in result.evaluation_set.positives])
    scores = result.ranked.scores[:, 0] if result.has_scores else np.zeros(len(is_correct))
    order = np.argsort(-scores, kind="stable")
    descending = ", highest score first" if result.has_scores else ""
    ascending = ", lowest score first" if result.has_scores else ""
    grids = [
        (f"Wrong{descending}", [q for q in order if not is_correct[q] and findable[q]]),
        (f"Without a positive{descending}", [q for q in order if not findable[q]]),
    ]
    if not only_wrong:
        grids.append((f"Correct{ascending}", [q for q in order[::-1] if is_correct[q]]))
    return [
        (
            f"{heading}: {min(max_rows, len(queries))} of {len(queries)}",
            _retrieval_grid(result, queries[:max_rows]),
        )
        for heading, queries in grids
        if queries
    ]


def _retrieval_grid(result: EvaluationResult, queries: Sequence[int]) -> str:
    """Render an HTML table with a row per query.

    If a query has no positive among the shown matches, a last column shows one.
    """
    shown = min(COLUMNS_SHOWN, result.measured.depth)
    with_positive = any(not result.measured.hits[q, :shown].any() for q in queries)
    heads = ["query", *(f"{rank + 1}" for rank in range(shown))]
    if with_positive:
        heads.append("a positive")
    rows = "".join(_grid_row(result, int(query), shown, with_positive) for query in queries)
    header = "".join(f"<th>{head}</th>" for head in heads)
    return f'<div class="wide"><table class="grid"><tr>{header}</tr>{rows}</table></div>'


def _grid_row(result: EvaluationResult, query: int, shown: int, with_positive: bool) -> str:
    photo = result.evaluation_set.queries[query]
    cells = [_grid_cell(photo, photo.name, "query", "")]
    scores, metres = result.scores, result.measured.metres
    for rank in range(shown):
        captions = []
        if scores is not None:
            captions.append(f"{scores[query, rank]:.3f}")
        if metres is not None and np.isfinite(metres[query, rank]):
            captions.append(f"{metres[query, rank]:.0f} m")
        kind = "right" if result.measured.hits[query, rank] else "wrong"
        match = result.match(query, rank)
        cells.append(_grid_cell(match, result.match_name(query, rank), kind, ", ".join(captions)))
    positives = result.evaluation_set.positives[query]
    if with_positive and not result.measured.hits[query, :shown].any() and len(positives):
        index, database = int(positives[0]), result.evaluation_set.database
        positive = database[index] if database else None
        name = positive.name if positive else str(index)
        cells.append(_grid_cell(positive, name, "right missed", ""))
    elif with_positive:
        cells.append("<td></td>")
    return f"<tr>{''.join(cells)}</tr>"


def _grid_cell(photo: DatasetPhoto | None, name: str, kind: str, caption: str) -> str:
    data_uri = _thumbnail_data_uri(photo.path) if photo else None
    image = (
        f'<img class="{kind}" src="{data_uri}" alt="{escape(name)}" loading="lazy">'
        if data_uri
        else f'<span class="none {kind}">no photo</span>'
    )
    verdict = {"query": "", "right": "correct", "wrong": "wrong"}.get(kind, "not retrieved")
    below = " · ".join(part for part in (verdict, caption) if part)
    label = f'<small title="{escape(name)}">{escape(_shorten(name))}</small>'
    return f"<td>{image}{label}<small>{escape(below)}</small></td>"


def _thumbnail_data_uri(path: Path) -> str | None:
    """Return the photo's thumbnail as a JPEG data URI; None if it cannot be read or decoded."""
    try:
        thumbnail = decode_photo(path.read_bytes(), _THUMBNAIL_PREPROCESSING, MAX_PIXELS).thumbnail
    except (OSError, Unprocessable):
        return None
    return "data:image/jpeg;base64," + base64.b64encode(thumbnail).decode()


def _shorten(name: str) -> str:
    return name if len(name) <= MAX_NAME_CHARACTERS else "…" + name[1 - MAX_NAME_CHARACTERS :]


def differences_section(result: EvaluationResult, comparison: RunComparison, shown: int) -> str:
    """Render the comparison with another run: differences, and queries won and lost."""
    rows = []
    for k, difference in comparison.differences.items():
        interval = difference.interval_in_points() or "too few queries for an interval"
        verdict = "significant" if difference.is_significant else "not significant"
        rows.append(
            f'<tr><th>R@{k}</th><td class="n">{100 * difference.mean:+.1f}</td><td>{interval}</td>'
            f'<td class="n">{difference.won}</td><td class="n">{difference.lost}</td>'
            f"<td>{verdict if difference.low is not None else ''}</td></tr>"
        )
    parts = [
        f"<h3>Compared with {escape(comparison.other)}</h3>",
        "<table><tr><th></th><th>percentage points</th><th>95 % interval</th><th>won</th>",
        f"<th>lost</th><th></th></tr>{''.join(rows)}</table>",
    ]
    for outcome, queries in (("Lost", comparison.lost), ("Won", comparison.won)):
        if queries:
            count = min(shown, len(queries))
            parts.append(f"<h4>{outcome} at rank 1: {count} of {len(queries)}</h4>")
            parts.append(_retrieval_grid(result, queries[:shown]))
    return "".join(parts)
