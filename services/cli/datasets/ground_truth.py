"""`placewise datasets ground-truth`: which photos of one list are right for those of another."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from services.cli.output import JsonOption, console, print_json, printable_path, report_errors
from shared.datasets.ground_truth import find_positives
from shared.datasets.ground_truth_files import sidecar_path, write_ground_truth
from shared.datasets.photo_lists import read_photo_list
from shared.datasets.rules import PositiveRule, parse_rule
from shared.errors import InvalidRequest, Misconfigured

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
        f"{printable_path(out)}, and {printable_path(sidecar_path(out))} beside it: {sum(counts)} positives ({meant}) "
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
