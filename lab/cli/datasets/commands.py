"""`placewise datasets`: check data sets and compute ground truth.

`check` reports what a folder contains and what is wrong with it. `list` prints the photos of an
evaluation set in order. `ground-truth` computes the positives of queries from positions. `synth` is
in its own module.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Column

from lab.cli.datasets.synth import synth
from lab.cli.evaluation.commands import ProtocolOption, RuleOption
from lab.datasets.check import (
    DatasetProblem,
    DatasetReport,
    find_undecodable_photos,
    inspect_dataset,
)
from lab.datasets.dataset import PHOTO_TABLE_HEADER, EvaluationSet, TrainingSet
from lab.datasets.ground_truth import PositiveRule, find_positives, parse_rule
from lab.datasets.ground_truth_files import sidecar_path, write_ground_truth
from lab.datasets.open_dataset import open_evaluation_set
from lab.datasets.photo_lists import read_photo_list
from services.cli.output import (
    Json,
    JsonOption,
    Table,
    err_console,
    print_json,
    print_message,
    print_note,
    print_result,
    print_table,
    printable_path,
    progress_bar,
    refuse_unwritable,
)
from shared.errors import InvalidRequest


def check(
    folder: Annotated[Path, typer.Argument(help="A data set, or a folder of data sets.")],
    decode: Annotated[
        bool, typer.Option("--decode", help="Decode every photo completely.")
    ] = False,
    protocol: ProtocolOption = None,
    rule: RuleOption = None,
    min_photos: Annotated[int, typer.Option(min=1, help="Ignore places with fewer photos.")] = 2,
    as_json: JsonOption = False,
) -> None:
    """Report the data sets in a folder: counts, cities, sets, fingerprints and problems.

    The exit code is 1 if there are problems.
    """
    with progress_bar() as progress:
        bar = progress.add_task("scanning the folder", total=None)
        report = inspect_dataset(folder, protocol=protocol, rule=rule, min_photos=min_photos)
        progress.remove_task(bar)
        problems = list(report.problems)
        if decode:
            bar = progress.add_task("decoding", total=len(report.photos()))
            problems += find_undecodable_photos(report, lambda count: progress.advance(bar, count))
    if as_json:
        print_json(_check_as_json(report, problems, decode))
    else:
        _print_check(report, problems, decode)
    if problems:
        raise typer.Exit(1)


def _check_as_json(report: DatasetReport, problems: list[DatasetProblem], decoded: bool) -> Json:
    return {
        "root": printable_path(report.root),
        "layouts": list(report.layouts),
        "training": _training_summary(report.training) if report.training else None,
        "evaluation": [_evaluation_summary(set_) for set_ in report.evaluation],
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


def _evaluation_summary(set_: EvaluationSet) -> Json:
    counts = [len(positives) for positives in set_.positives]
    return {
        "name": set_.name,
        "database": len(set_.database),
        "queries": len(set_.queries),
        "queries_without_positives": len(set_.without_positives),
        "positives_per_query": {"mean": statistics.fmean(counts) if counts else 0.0}
        | {"most": max(counts, default=0)},
        "rule": set_.rule,
        "paired_by": set_.paired_by,
        "protocol": set_.protocol,
        "fingerprint": set_.fingerprint,
    }


def _print_check(report: DatasetReport, problems: list[DatasetProblem], decoded: bool) -> None:
    print_message(f"{printable_path(report.root)}: {', '.join(dict.fromkeys(report.layouts))}.")
    if report.training is not None:
        _print_training(_training_summary(report.training))
    for set_ in report.evaluation:
        _print_evaluation(_evaluation_summary(set_))
    if not problems:
        print_message(
            "All photos can be decoded."
            if decoded
            else "All photos exist. Pass --decode to decode them."
        )
    for problem in problems:
        err_console.print(f"[red]{problem.code}[/red] {escape(problem.detail)}", soft_wrap=True)
        for example in problem.examples:
            print_note(f"  {example}")
        if problem.examples and problem.count > len(problem.examples):
            print_note(f"  and {problem.count - len(problem.examples)} more")


def _print_training(figures: Json) -> None:
    sizes = figures["photos_per_place"]
    cities = "1 city" if len(figures["cities"]) == 1 else f"{len(figures['cities'])} cities"
    print_message(
        f"Training set: {figures['photos']} photos of {figures['places']} places in "
        f"{cities} ({figures['layout']}), {sizes['least']} to "
        f"{sizes['most']} photos per place (median {sizes['median']:g}); fingerprint "
        f"{figures['fingerprint'][:12]}."
    )
    table = Table("city", Column("places", justify="right"), Column("photos", justify="right"))
    for city, counts in figures["cities"].items():
        table.add_row(escape(city), str(counts["places"]), str(counts["photos"]))
    print_table(table)


def _print_evaluation(summary: Json) -> None:
    pairs = f", photos paired by {summary['paired_by']}" if summary["paired_by"] else ""
    # Not a table: it would truncate long names and fingerprints.
    print_message(
        f"{summary['name']}: {summary['database']} database photos, "
        f"{summary['queries']} queries ({summary['queries_without_positives']} without positives); "
        f"{summary['positives_per_query']['mean']:.1f} positives per query "
        f"({summary['rule']}{pairs}), protocol {summary['protocol']}, fingerprint "
        f"{summary['fingerprint'][:12]}."
    )


PhotoListOption = Annotated[
    Path,
    typer.Option(
        help="List of photos: .npy of paths, text with a path per line, or CSV with the header "
        f"{PHOTO_TABLE_HEADER}; all columns but path are optional."
    ),
]


def list_photos(
    folder: Annotated[Path, typer.Argument(help="Folder of the data set.")],
    set_name: Annotated[
        str | None, typer.Option("--set", help="Set of the folder. Required if there are several.")
    ] = None,
    protocol: ProtocolOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the photos of an evaluation set in order: the database, then the queries.

    `row` is the photo's row in the files of `placewise evaluate --rows` and its index in
    predictions.
    """
    evaluation_set = open_evaluation_set(folder, set_name, protocol=protocol)
    roles = {"database": evaluation_set.database, "query": evaluation_set.queries}
    if as_json:
        print_json({role: [str(photo.path) for photo in photos] for role, photos in roles.items()})
        return
    table = Table("role", Column("row", justify="right"), "file")
    for role, photos in roles.items():
        for row, photo in enumerate(photos):
            table.add_row(role, str(row), escape(str(photo.path)))
    print_table(table)


def ground_truth(
    database: PhotoListOption,
    queries: PhotoListOption,
    out: Annotated[
        Path, typer.Option(help="Output file (.npy); a .json file is written next to it.")
    ],
    radius: Annotated[
        float | None, typer.Option(min=0, help="Radius in metres, inclusive. Default: 25.")
    ] = None,
    rule: Annotated[
        str | None,
        typer.Option(help="Another criterion: heading 25 40, frames 5, frames 5 in sequence, ..."),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="Root of relative paths, for EXIF positions. Default: folder of each list."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compute the positives of each query, in the format of sf_xs's gtImages.npy.

    Rows and indices follow the order of the lists. OUT.json records the fingerprints of both lists
    to detect a mismatch when the file is used.
    """
    criterion = _resolve_rule(radius, rule)
    if out.suffix != ".npy":
        raise InvalidRequest("bad_out", f"--out {out}: the file name must end in .npy.")
    database_photos = read_photo_list(database, folder)
    query_photos = read_photo_list(queries, folder)
    positives = find_positives(criterion, query_photos, database_photos)
    with refuse_unwritable(out):
        write_ground_truth(
            out,
            positives,
            database=[photo.name for photo in database_photos],
            queries=[photo.name for photo in query_photos],
            rule=str(criterion),
        )
    counts = [len(indices) for indices in positives]
    figures = {
        "out": printable_path(out),
        "rule": str(criterion),
        "database": len(database_photos),
        "queries": len(query_photos),
        "positives": sum(counts),
        "queries_without_positives": counts.count(0),
    }
    print_result(
        figures,
        as_json,
        f"Wrote {printable_path(out)} and {printable_path(sidecar_path(out))}: "
        f"{sum(counts)} positives ({criterion}) "
        f"for {len(query_photos)} queries among {len(database_photos)} database photos; "
        f"{counts.count(0)} queries have none.",
    )


def _resolve_rule(radius: float | None, rule: str | None) -> PositiveRule:
    if rule is None:
        metres = 25.0 if radius is None else radius
        if not math.isfinite(metres):
            raise InvalidRequest(
                "unknown_rule", f"--radius must be a finite number of metres, not {metres}."
            )
        return PositiveRule("radius", radius_m=metres)
    if radius is not None:
        raise InvalidRequest("which_rule", "--radius and --rule exclude each other.")
    return parse_rule(rule)


app = typer.Typer(help="Check, complete and generate data sets.", no_args_is_help=True)
app.command("check")(check)
app.command("list")(list_photos)
app.command("ground-truth")(ground_truth)
app.command("synth")(synth)
