"""`placewise datasets check`: what a folder holds, and what is wrong with it."""

from __future__ import annotations

import statistics
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Column, Table

from services.cli.output import (
    JsonOption,
    console,
    err_console,
    print_json,
    printable_path,
    progress_bar,
    report_errors,
)
from shared.datasets.recognise import (
    DatasetProblem,
    DatasetReport,
    find_undecodable_photos,
    inspect_dataset,
)
from shared.datasets.shots import EvaluationSet, TrainingSet

Json = dict[str, Any]


def check(
    folder: Annotated[Path, typer.Argument(help="A data set, or a folder of several.")],
    decode: Annotated[
        bool, typer.Option("--decode", help="Open every photo, to its last pixel.")
    ] = False,
    protocol: Annotated[
        str | None, typer.Option(help="How sets are put together, such as msls-official or vme.")
    ] = None,
    rule: Annotated[
        str | None,
        typer.Option(help="Who is right: radius 25, heading 25 40, frames 5, place-label."),
    ] = None,
    min_photos: Annotated[
        int, typer.Option(min=1, help="Places with fewer photos are not counted.")
    ] = 2,
    as_json: JsonOption = False,
) -> None:
    """Say which data sets a folder holds: counts, cities, sets, fingerprints, problems.

    Exits with 1 where something is wrong.
    """
    with report_errors(as_json), progress_bar() as progress:
        looking = progress.add_task("looking through the folder", total=None)
        found = inspect_dataset(folder, protocol=protocol, rule=rule, min_photos=min_photos)
        progress.remove_task(looking)
        problems = list(found.problems)
        if decode:
            bar = progress.add_task("decoding", total=len(found.photos()))
            problems += find_undecodable_photos(found, lambda count: progress.advance(bar, count))
    if as_json:
        print_json(_check_as_json(found, problems, decode))
    else:
        _print_check(found, problems, decode)
    if problems:
        raise typer.Exit(1)


def _check_as_json(found: DatasetReport, problems: list[DatasetProblem], decoded: bool) -> Json:
    return {
        "root": printable_path(found.root),
        "layouts": list(found.layouts),
        "training": _training_summary(found.training) if found.training else None,
        "evaluation": [_evaluation_summary(one) for one in found.evaluation],
        "decoded": decoded,
        "problems": [asdict(problem) for problem in problems],
    }


def _training_summary(training: TrainingSet) -> Json:
    sizes = [len(place.photos) for place in training.places]
    places = Counter(place.city for place in training.places)
    photos: Counter[str] = Counter()
    for place in training.places:
        photos[place.city] += len(place.photos)
    return {
        "name": training.name,
        "layout": training.layout,
        "places": len(sizes),
        "photos": sum(sizes),
        "photos_per_place": {
            "least": min(sizes),
            "median": statistics.median(sizes),
            "most": max(sizes),
        },
        "cities": {
            city: {"places": places[city], "photos": photos[city]} for city in training.cities
        },
        "fingerprint": training.fingerprint,
    }


def _evaluation_summary(one: EvaluationSet) -> Json:
    counts = [len(found) for found in one.positives]
    return {
        "name": one.name,
        "database": len(one.database),
        "queries": len(one.queries),
        "queries_without_positives": len(one.without_positives),
        "positives_per_query": {"mean": statistics.fmean(counts) if counts else 0.0}
        | {"most": max(counts, default=0)},
        "rule": one.rule,
        "protocol": one.protocol,
        "fingerprint": one.fingerprint,
    }


def _print_check(found: DatasetReport, problems: list[DatasetProblem], decoded: bool) -> None:
    console.print(
        f"{printable_path(found.root)}: {', '.join(dict.fromkeys(found.layouts))}.", soft_wrap=True
    )
    if found.training is not None:
        _print_training(_training_summary(found.training))
    for one in found.evaluation:
        _print_evaluation(_evaluation_summary(one))
    if not problems:
        console.print(
            "All photos decode." if decoded else "All photos are there; --decode opens them.",
            soft_wrap=True,
        )
    for problem in problems:
        err_console.print(f"[red]{problem.code}[/red] {escape(problem.detail)}", soft_wrap=True)
        for example in problem.examples:
            err_console.print(f"  {escape(example)}", soft_wrap=True)
        if problem.examples and problem.count > len(problem.examples):
            err_console.print(f"  and {problem.count - len(problem.examples)} more")


def _print_training(figures: Json) -> None:
    sizes = figures["photos_per_place"]
    console.print(
        f"To learn from: {figures['photos']} photos of {figures['places']} places in "
        f"{len(figures['cities'])} cities ({figures['layout']}), {sizes['least']} to "
        f"{sizes['most']} of a place, the median {sizes['median']:g}; fingerprint "
        f"{figures['fingerprint'][:12]}.",
        soft_wrap=True,
    )
    table = Table("city", Column("places", justify="right"), Column("photos", justify="right"))
    for city, counts in figures["cities"].items():
        table.add_row(escape(city), str(counts["places"]), str(counts["photos"]))
    console.print(table)


def _print_evaluation(one: Json) -> None:
    # Lines, not a table: names are long, and fingerprints must not be cut.
    console.print(
        f"{escape(one['name'])}: {one['database']} database photos, {one['queries']} queries, of "
        f"which {one['queries_without_positives']} have no positive; "
        f"{one['positives_per_query']['mean']:.1f} positives each ({escape(one['rule'])}), "
        f"protocol {one['protocol']}, fingerprint {one['fingerprint'][:12]}.",
        soft_wrap=True,
    )
