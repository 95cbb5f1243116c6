"""`placewise import-anyloc DIR`: the predecessor's photos, with all that it knew of them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from services.cli.client import connect
from services.cli.ingest.anyloc_reader import AnylocFolder, read_anyloc_folder
from services.cli.ingest.upload import FitOption, UpdateOption, upload_photos
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    err_console,
    print_failures,
    print_json,
    progress_bar,
    report_errors,
)
from shared.client import Json

DESCRIPTORS_NOTE = (
    "Descriptors are made anew: those under features/ belong to another vocabulary and another "
    "preprocessing, and can't be compared with this map's."
)


def import_anyloc(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            exists=True,
            file_okay=False,
            help="The folder of an AnyLoc similarity service, or one above it.",
        ),
    ],
    database: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="Its similarity.db; left out: the one below DIR."
        ),
    ] = None,
    uploads: Annotated[
        Path | None,
        typer.Option(
            exists=True, file_okay=False, help="Its photos; left out: uploads/ below DIR."
        ),
    ] = None,
    update: UpdateOption = False,
    fit: FitOption = True,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Upload the photos of an AnyLoc similarity service with their names, tags and metadata.

    Its folder is only read. Run it again after an interruption: nothing is stored twice.
    """
    with report_errors(as_json):
        found = read_anyloc_folder(folder, database, uploads)
        with connect(server, map_name, key) as client, progress_bar() as progress:
            report = _build_report(
                found, upload_photos(client, found.photos, fit, progress, update=update)
            )
        if as_json:
            print_json(report)
        else:
            _print_report(report)
        if report["refused"] or report["failed"] or report["missing"]:
            raise typer.Exit(1)


def _build_report(found: AnylocFolder, uploaded: Json) -> Json:
    return {
        "database": str(found.database),
        "rows": found.rows,
        "photos": uploaded["photos"],
        "unlisted": found.unlisted,
        "imported": uploaded["uploaded"],
        "already_there": uploaded["already_there"],
        "missing": found.missing,
        "duplicates": found.duplicates,
        "refused": uploaded["refused"],
        "failed": uploaded["failed"],
        "searchable": uploaded["searchable"],
        "vocabulary": uploaded["vocabulary"],
        "fitted": uploaded["fitted"],
        "notes": [DESCRIPTORS_NOTE, *_vocabulary_note(found)],
    }


def _vocabulary_note(found: AnylocFolder) -> list[str]:
    if not found.vocabularies:
        return []
    where = ", ".join(map(str, found.vocabularies))
    return [
        (
            f"Its vocabulary is not taken ({where}): the predecessor may have filled it with "
            "random numbers or spoilt it at a start. One that you trust: "
            "placewise vocabulary import FILE."
        )
    ]


def _print_report(report: Json) -> None:
    for note in report["notes"]:
        err_console.print(escape(note), soft_wrap=True)
    err_console.print(
        f"{report['rows']} rows: {report['imported']} photos imported, {report['already_there']} "
        f"were there already, {len(report['duplicates'])} the same as another, "
        f"{len(report['missing'])} missing, {len(report['refused'])} refused. "
        f"{report['unlisted']} of the photos were in no row.",
        soft_wrap=True,
    )
    err_console.print(
        f"{report['searchable']} photos are searchable in the map "
        f"(vocabulary: {report['vocabulary']})."
    )
    print_failures(report, "missing", "duplicates", "refused", "failed")
    err_console.print(f"Ask: {sys.argv[0]} query PHOTO")
