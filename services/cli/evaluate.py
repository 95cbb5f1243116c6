"""`placewise evaluate` on a live map: recall of its own photos and of its labelled queries.

The command of the lab, which replaces this one, adds data sets and predictions.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Annotated
from uuid import UUID

import typer
from rich.table import Column

from placewise.answers import Evaluation
from placewise.protocol import drop_none
from services.cli.client import MapOptions, wait_for_job
from services.cli.environment import lab_missing
from services.cli.output import (
    Json,
    Table,
    format_percent,
    print_json,
    print_message,
    print_table,
    progress_bar,
)

MAX_EVALUATIONS_SHOWN = 6  # the current evaluation and earlier ones

SampleOption = Annotated[
    int | None,
    typer.Option(min=1, help="Live map: number of photos to query with. Default: 1000."),
]
SeedOption = Annotated[int | None, typer.Option(min=0, help="Live map: random seed.")]


def evaluate(
    common: MapOptions,
    data: Annotated[Path | None, typer.Option(hidden=True)] = None,
    predictions: Annotated[Path | None, typer.Option(hidden=True)] = None,
    sample: SampleOption = None,
    seed: SeedOption = None,
) -> None:
    """Measure retrieval recall in a live map.

    Evaluates the map with its own photos (leave-one-out) and its labelled queries.
    """
    for option, value in (("--data", data), ("--predictions", predictions)):
        if value is not None:
            raise lab_missing(f"`evaluate {option}`")
    evaluate_map(common, sample, seed)


def evaluate_map(common: MapOptions, sample: int | None, seed: int | None) -> None:
    """Evaluate a map with its own photos (leave-one-out) and its labelled queries."""
    parameters = drop_none(sample=sample, seed=seed)
    with common.connect() as client, progress_bar() as progress:
        job = wait_for_job(client, client.evaluate(**parameters), progress, "evaluating")
        requested = (e for e in client.evaluations() if not e.automatic)
        shown = list(islice(requested, MAX_EVALUATIONS_SHOWN))
        origins = {str(each.vocabulary_id): each.origin for each in client.vocabularies()}
        vocabularies = {
            each.generation_id: origins.get(str(each.vocabulary_id), "none")
            for each in client.generations()
        }
    if common.as_json:
        print_json(job.result or {})
        return
    _print_evaluations(shown, vocabularies)


def _print_evaluations(evaluations: list[Evaluation], vocabularies: dict[UUID, str]) -> None:
    table = Table(
        Column("evaluated", no_wrap=True),
        "vocabulary",
        "photos",
        "queries",
        *(Column(f"R@{k}", justify="right", no_wrap=True) for k in (1, 5, 10)),
    )
    for evaluation in evaluations:
        figures = evaluation.figures
        for kind, recall in _recall_rows(figures):
            table.add_row(
                f"{evaluation.evaluated_at:%m-%d %H:%M:%S}",
                vocabularies.get(evaluation.generation_id, ""),
                str(evaluation.searchable),
                f"{recall['queries']} {kind}",
                *(format_percent(recall[f"R@{k}"]) for k in (1, 5, 10)),
            )
    print_table(table)
    used = evaluations[0].figures
    if places := used["places"]:
        print_table(answers_table(places))
    if with_matches := used["places_with_matches"]:
        print_message(
            "With matches of local features, which "
            + ("are used:" if used["uses_matches"] else "are not used, as they answer less:")
        )
        print_table(answers_table(with_matches))
    for line in _estimate_lines(used):
        print_message(line)


def answers_table(places: Json) -> Table:
    """Answers of a place model at each certainty, with 95 % intervals, and the ECE of the levels.

    Args:
        places: Figures of `evaluate_places` or `measure_places`.
    """
    errors = ", ".join(
        "-" if level["calibration_error"] is None else f"{level['calibration_error']:.3f}"
        for level in places["levels"]
    )
    from_queries = "outside_at_finest_level" in places["answers"][0]
    others = ("outside the map", "outside_at_finest_level")
    if not from_queries:
        others = ("impostors", "impostors_at_finest_level")
    source = places["source"].replace("_", " ")
    measured = f"queries; fitted on {source}"
    if not from_queries:
        own = "" if source == "labelled queries" else f", own photos each {places['own_photos']}"
        measured = f"{source}, cross-validated{own}"
    table = Table(
        Column("certainty", justify="right"),
        *(
            Column(name, justify="right")
            for name in ("answered", "at the finest level", "correct", "mean level", others[0])
        ),
        caption=f"{places['samples']} {measured}. Expected calibration error by level, finest "
        f"first: {errors}.",
    )
    for answers in places["answers"]:
        mean_level = answers["mean_level"]
        table.add_row(
            f"{answers['certainty']:g}",
            *(
                _format_share(answers[key])
                for key in ("answered", "answered_at_finest_level", "precision")
            ),
            "-" if mean_level is None else f"{mean_level:.2f}",
            format_percent(answers[others[1]]),
        )
    return table


def _format_share(figure: Json) -> str:
    """Format a share with its 95 % interval, if it has one."""
    text = format_percent(figure["mean"])
    if figure["interval"] is None:
        return text
    low, high = figure["interval"]
    return f"{text} ({100 * low:.1f} to {100 * high:.1f})"


def _recall_rows(figures: Json) -> list[tuple[str, Json]]:
    rows = [
        ("own photos", figures["leave_one_out"]),
        ("without sequence", figures["leave_one_out_without_sequence"]),
    ]
    if figures["places_with_matches"]:
        rows += [
            ("own photos, by matches", figures["leave_one_out_by_matches"]),
            ("without sequence, by matches", figures["leave_one_out_without_sequence_by_matches"]),
        ]
    if figures["labelled_queries"]:
        rows.append(("labelled queries", figures["labelled_queries"]))
    return rows


def _estimate_lines(figures: Json) -> list[str]:
    labelled = figures["labelled_queries"]
    lines = [
        f"Positive match: within {figures['radius_m']:g} m, or the same place label.",
        "Own photos find the frames before and after them, which flatters.",
        "Without sequence: nor photos of the same minute or of near numbers in their names.",
    ]
    if labelled is None:
        lines.append(
            "Photos of another day, with coordinates or labels, make the probabilities better: "
            "placewise index DIR --role query."
        )
        return lines
    lines.append(
        f"{format_percent(labelled['accepted_in_map'])} of the {labelled['queries']} queries in "
        f"the map and {format_percent(labelled['false_accepts'])} of the "
        f"{labelled['out_of_map']} queries outside it are accepted. "
        f"{format_percent(labelled['right_of_accepted'])} of the accepted queries are correct."
    )
    return lines
