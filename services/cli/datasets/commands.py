"""The group `placewise datasets`.

`placewise datasets check`: what a folder holds, and what is wrong with it.

`placewise datasets ground-truth`: which photos of one list are right for those of another.

`placewise datasets audit`: answers that count as wrong although they may be right.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Column, Table

from services.cli.datasets.synth import synth
from services.cli.output import (
    JsonOption,
    console,
    err_console,
    print_json,
    printable_path,
    progress_bar,
    report_errors,
)
from shared.datasets.check import (
    MAX_RULE_MULTIPLE,
    DatasetProblem,
    DatasetReport,
    SuspectLabel,
    find_suspect_labels,
    find_undecodable_photos,
    inspect_dataset,
)
from shared.datasets.dataset import EvaluationSet, TrainingSet
from shared.datasets.ground_truth import PositiveRule, find_positives, parse_rule
from shared.datasets.ground_truth_files import sidecar_path, write_ground_truth
from shared.datasets.open_dataset import open_evaluation_set
from shared.datasets.photo_lists import read_photo_list
from shared.errors import InvalidRequest, Misconfigured

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


PhotoListOption = Annotated[
    Path, typer.Option(help="A .npy of paths, a CSV, or a text of one path a line.")
]


def ground_truth(
    database: PhotoListOption,
    queries: PhotoListOption,
    out: Annotated[Path, typer.Option(help="The .npy to write, and beside it a .json.")],
    radius: Annotated[
        float | None, typer.Option(min=0, help="Metres, the bound included. Left out: 25.")
    ] = None,
    rule: Annotated[
        str | None,
        typer.Option(help="Another rule: heading 25 40, frames 5, frames 5 in sequence, ..."),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(help="Where the paths begin, for EXIF positions. Left out: each list's."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write which database photos are right for each query, in the format of sf_xs's gtImages.npy.

    The rows are in the order of the lists as given. OUT.json keeps the fingerprints of both lists,
    so that they are never taken for the rows of others.
    """
    with report_errors(as_json):
        meant = _resolve_rule(radius, rule)
        if out.suffix != ".npy":
            raise InvalidRequest("bad_out", f"--out {out}: the file's name has to end in .npy.")
        listed, asked = read_photo_list(database, folder), read_photo_list(queries, folder)
        found = find_positives(meant, asked, listed)
        try:
            write_ground_truth(
                out,
                found,
                database=[shot.name for shot in listed],
                queries=[shot.name for shot in asked],
                rule=str(meant),
            )
        except OSError as error:
            raise Misconfigured("out_unwritable", f"Can't write {out}: {error}.") from error
    counts = [len(positives) for positives in found]
    figures = {
        "out": printable_path(out),
        "rule": str(meant),
        "database": len(listed),
        "queries": len(asked),
        "positives": sum(counts),
        "queries_without_positives": counts.count(0),
    }
    if as_json:
        print_json(figures)
        return
    console.print(
        f"{printable_path(out)}, and {printable_path(sidecar_path(out))} beside it: "
        f"{sum(counts)} positives ({meant}) "
        f"of {len(asked)} queries among {len(listed)} database photos; {counts.count(0)} queries "
        "have none.",
        soft_wrap=True,
    )


def _resolve_rule(radius: float | None, rule: str | None) -> PositiveRule:
    if rule is None:
        metres = 25.0 if radius is None else radius
        if not math.isfinite(metres):
            raise InvalidRequest("unknown_rule", f"--radius {metres} is no number of metres.")
        return PositiveRule("radius", radius_m=metres)
    if radius is not None:
        raise InvalidRequest("which_rule", "Give --radius or --rule, not both.")
    return parse_rule(rule)


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


app = typer.Typer(help="Data sets: check one, complete one, or draw one.", no_args_is_help=True)
app.command("check")(check)
app.command("ground-truth")(ground_truth)
app.command("audit")(audit)
app.command("synth")(synth)
