"""What changed from another run: recalls query by query, and which queries were won and lost."""

from __future__ import annotations

from html import escape

from services.trainer.evaluation.against import RunComparison
from services.trainer.evaluation.report.grids import retrieval_grid
from services.trainer.evaluation.result import EvaluationResult


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
