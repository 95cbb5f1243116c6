"""`placewise datasets audit`: answers that count as wrong although they may be right."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Column, Table

from services.cli.output import JsonOption, console, print_json, report_errors
from shared.datasets.audit import MAX_RULE_MULTIPLE, SuspectLabel, find_suspect_labels
from shared.datasets.sets import open_evaluation_set
from shared.errors import InvalidRequest

MAX_SUSPECTS_SHOWN = 50


def audit(
    folder: Annotated[Path, typer.Argument(help="The data set.")],
    predictions: Annotated[
        Path, typer.Option(help=".npy (queries, k) of database indices, best first.")
    ],
    scores: Annotated[
        Path | None, typer.Option(help=".npy (queries, k), the higher the better.")
    ] = None,
    min_score: Annotated[
        float | None,
        typer.Option(help="Confident from here on. Left out: the median score of right answers."),
    ] = None,
    name: Annotated[str | None, typer.Option("--set", help="Which set, of several.")] = None,
    protocol: Annotated[str | None, typer.Option()] = None,
    rule: Annotated[str | None, typer.Option()] = None,
    as_json: JsonOption = False,
) -> None:
    """List confident first matches that the ground truth calls wrong, though they lie near.

    Near is 4 times the rule's metres or frames, whatever the heading. Look at these pairs: where
    they show one place, the ground truth errs, and not the descriptor.
    """
    with report_errors(as_json):
        evaluation = open_evaluation_set(folder, name, protocol=protocol, rule=rule)
        ranked = _load_array(predictions, "iu").astype(np.int64)
        outside = ranked.size and not 0 <= ranked.min() <= ranked.max() < len(evaluation.database)
        if outside:
            raise InvalidRequest(
                "predictions_out_of_range",
                f"{predictions} speaks of photos {ranked.min()} to {ranked.max()}; the database of "
                f"{evaluation.name} has {len(evaluation.database)}, from 0.",
            )
        given = None if scores is None else _load_array(scores, "f").astype(np.float32)
        suspects = find_suspect_labels(evaluation, ranked, given, min_score=min_score)
    if as_json:
        print_json(
            {
                "set": evaluation.name,
                "rule": evaluation.rule,
                "protocol": evaluation.protocol,
                "fingerprint": evaluation.fingerprint,
                "queries": len(evaluation.queries),
                "suspects": [asdict(suspect) for suspect in suspects],
            }
        )
        return
    console.print(
        f"{len(suspects)} of {len(evaluation.queries)} queries of {escape(evaluation.name)} have a "
        f"confident first match within {MAX_RULE_MULTIPLE:g} times {escape(evaluation.rule)} that "
        "counts as wrong.",
        soft_wrap=True,
    )
    if suspects:
        _print_suspects(suspects)


def _print_suspects(suspects: list[SuspectLabel]) -> None:
    table = Table(
        *(Column(name, justify="right") for name in ("score", "metres", "degrees")),
        "query",
        "first match",
    )
    for one in suspects[:MAX_SUSPECTS_SHOWN]:
        table.add_row(
            "-" if one.score is None else f"{one.score:.3f}",
            "-" if one.metres is None else f"{one.metres:.1f}",
            "-" if one.degrees is None else f"{one.degrees:.0f}",
            escape(one.query_name),
            escape(one.database_name),
        )
    console.print(table)
    if len(suspects) > MAX_SUSPECTS_SHOWN:
        console.print(f"and {len(suspects) - MAX_SUSPECTS_SHOWN} more: --json lists all.")


def _load_array(path: Path, kinds: str) -> NDArray[Any]:
    try:
        rows: NDArray[Any] = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InvalidRequest("bad_predictions", f"Can't read {path}: {error}.") from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.dtype.kind not in kinds:
        raise InvalidRequest("bad_predictions", f"{path} is no array (queries, k) of numbers.")
    return rows
