"""Retrieval grids: a query in blue, what was found in green where it is right and red where not.

What changed from another run: recalls query by query, and which queries were won and lost.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from shared.datasets.open_dataset import DatasetPhoto
from shared.errors import Unprocessable
from shared.evaluation.results import EvaluationResult, RunComparison
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import get_preprocessing

COLUMNS_SHOWN = 5  # database photos of a row
MAX_PIXELS = 200_000_000
_THUMBNAIL_PREPROCESSING = get_preprocessing("square32")  # the thumbnail is what is wanted


def retrieval_grids(
    result: EvaluationResult, max_rows: int, *, only_wrong: bool
) -> list[tuple[str, str]]:
    """Headings with tables: the wrong ones of highest score, the right ones of lowest; at most
    `max_rows` rows each."""
    first = result.measured.hits[:, 0]
    findable = np.array([len(found) > 0 for found in result.asked.positives])
    sure = result.ranked.scores[:, 0] if result.has_scores else np.zeros(len(first))
    order = np.argsort(-sure, kind="stable")
    surest = ", the surest first" if result.has_scores else ""
    least_sure = ", the least sure first" if result.has_scores else ""
    kinds = [
        (f"Wrong{surest}", [q for q in order if not first[q] and findable[q]]),
        (f"Without a right photo{surest}", [q for q in order if not findable[q]]),
    ]
    if not only_wrong:
        kinds.append((f"Right{least_sure}", [q for q in order[::-1] if first[q]]))
    return [
        (
            f"{heading}: {min(max_rows, len(found))} of {len(found)}",
            retrieval_grid(result, found[:max_rows]),
        )
        for heading, found in kinds
        if found
    ]


def retrieval_grid(result: EvaluationResult, queries: Sequence[int]) -> str:
    """One table with a row for each of the queries."""
    shown = min(COLUMNS_SHOWN, result.measured.depth)
    with_right = any(not result.measured.hits[q, :shown].any() for q in queries)
    heads = ["query", *(f"{rank + 1}" for rank in range(shown))]
    if with_right:
        heads.append("a right one")
    rows = "".join(_grid_row(result, int(query), shown, with_right) for query in queries)
    named = "".join(f"<th>{head}</th>" for head in heads)
    return f'<div class="wide"><table class="grid"><tr>{named}</tr>{rows}</table></div>'


def _grid_row(result: EvaluationResult, query: int, shown: int, with_right: bool) -> str:
    shot = result.asked.queries[query]
    cells = [_grid_cell(shot, shot.name, "query", "")]
    scores, metres = result.scores, result.measured.metres
    for rank in range(shown):
        said = []
        if scores is not None:
            said.append(f"{scores[query, rank]:.3f}")
        if metres is not None and np.isfinite(metres[query, rank]):
            said.append(f"{metres[query, rank]:.0f} m")
        kind = "right" if result.measured.hits[query, rank] else "wrong"
        match = result.match(query, rank)
        cells.append(_grid_cell(match, result.match_name(query, rank), kind, ", ".join(said)))
    positives = result.asked.positives[query]
    if with_right and not result.measured.hits[query, :shown].any() and len(positives):
        number = int(positives[0])
        there = result.asked.database[number] if result.asked.database else None
        cells.append(_grid_cell(there, there.name if there else str(number), "right missed", ""))
    elif with_right:
        cells.append("<td></td>")
    return f"<tr>{''.join(cells)}</tr>"


def _grid_cell(shot: DatasetPhoto | None, name: str, kind: str, caption: str) -> str:
    address = _thumbnail_data_uri(shot.path) if shot else None
    seen = (
        f'<img class="{kind}" src="{address}" alt="{escape(name)}" loading="lazy">'
        if address
        else f'<span class="none {kind}">no photo</span>'
    )
    word = {"query": "", "right": "right", "wrong": "wrong"}.get(kind, "not found")
    below = " · ".join(part for part in (word, caption) if part)
    named = f'<small title="{escape(name)}">{escape(_shorten(name))}</small>'
    return f"<td>{seen}{named}<small>{escape(below)}</small></td>"


def _thumbnail_data_uri(path: Path) -> str | None:
    """The photo as a small JPEG in a data URI; None where there is none to be seen, which the cell
    then says."""
    try:
        thumbnail = decode_photo(path.read_bytes(), _THUMBNAIL_PREPROCESSING, MAX_PIXELS).thumbnail
    except (OSError, Unprocessable):
        return None
    return "data:image/jpeg;base64," + base64.b64encode(thumbnail).decode()


def _shorten(name: str, characters: int = 34) -> str:
    return name if len(name) <= characters else "…" + name[1 - characters :]


def differences_section(result: EvaluationResult, comparison: RunComparison, shown: int) -> str:
    rows = []
    for k, found in comparison.differences.items():
        interval = (
            "too few queries for an interval"
            if found.low is None or found.high is None
            else f"{100 * found.low:+.1f} to {100 * found.high:+.1f}"
        )
        verdict = "more than chance" if found.is_significant else "may be chance"
        rows.append(
            f'<tr><th>R@{k}</th><td class="n">{100 * found.mean:+.1f}</td><td>{interval}</td>'
            f'<td class="n">{found.won}</td><td class="n">{found.lost}</td>'
            f"<td>{verdict if found.low is not None else ''}</td></tr>"
        )
    parts = [
        f"<h3>Against {escape(comparison.other)}</h3>",
        "<table><tr><th></th><th>points</th><th>95 % interval</th><th>won</th><th>lost</th>",
        f"<th></th></tr>{''.join(rows)}</table>",
    ]
    for word, queries in (("Lost", comparison.lost), ("Won", comparison.won)):
        if queries:
            count = min(shown, len(queries))
            parts.append(f"<h4>{word} at rank 1: {count} of {len(queries)}</h4>")
            parts.append(retrieval_grid(result, queries[:shown]))
    return "".join(parts)
