"""`placewise import-anyloc DIR`: import photos from an AnyLoc similarity service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.client import client_command, connect
from services.cli.ingest.anyloc_reader import AnylocFolder, read_anyloc_folder
from services.cli.ingest.upload import (
    NoFitOption,
    UpdateOption,
    switch_off_fits,
    upload_photos,
)
from services.cli.output import (
    Json,
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    print_failures,
    print_json,
    print_note,
    progress_bar,
)

DESCRIPTORS_NOTE = (
    "Descriptors are computed again: those in features/ use another vocabulary and another "
    "preprocessing and can't be compared with this map's."
)


def import_anyloc(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            exists=True,
            file_okay=False,
            help="Folder of an AnyLoc similarity service, or a parent of it.",
        ),
    ],
    database: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="Path of similarity.db. Default: the one below DIR."
        ),
    ] = None,
    uploads: Annotated[
        Path | None,
        typer.Option(
            exists=True, file_okay=False, help="Folder of the photos. Default: uploads/ below DIR."
        ),
    ] = None,
    update: UpdateOption = False,
    no_fit: NoFitOption = False,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Upload the photos of an AnyLoc similarity service with their names, tags and metadata.

    DIR is only read. The command is idempotent: run it again after an interruption.
    """
    source = read_anyloc_folder(folder, database, uploads)
    with connect(server, map_name, key) as client, progress_bar() as progress:
        if no_fit:
            switch_off_fits(client)
        report = _build_report(
            source, upload_photos(client, source.photos, progress, update=update)
        )
    if as_json:
        print_json(report)
    else:
        _print_report(report)
        print_note(f"Next: {client_command('query', 'PHOTO', server=server, map_name=map_name)}")
    if report["refused"] or report["failed"] or report["missing"]:
        raise typer.Exit(1)


def _build_report(source: AnylocFolder, uploaded: Json) -> Json:
    return {
        "database": str(source.database),
        "rows": source.rows,
        "unlisted": source.unlisted,
        "imported": uploaded.pop("uploaded"),
        "missing": source.missing,
        "duplicates": source.duplicates,
        **uploaded,
        "notes": [DESCRIPTORS_NOTE, *_vocabulary_note(source)],
    }


def _vocabulary_note(source: AnylocFolder) -> list[str]:
    if not source.vocabularies:
        return []
    files = ", ".join(map(str, source.vocabularies))
    return [
        (
            f"The vocabulary was not imported ({files}): the AnyLoc service may have initialised "
            "it with random numbers or corrupted it at startup. To import a vocabulary that you "
            "trust: placewise vocabulary import FILE."
        )
    ]


def _print_report(report: Json) -> None:
    for note in report["notes"]:
        print_note(note)
    print_note(
        f"{report['rows']} database rows: {report['imported']} photos imported, "
        f"{report['already_there']} already stored, {len(report['duplicates'])} duplicates, "
        f"{len(report['missing'])} missing, {len(report['refused'])} refused. "
        f"{report['unlisted']} photos had no database row."
    )
    print_note(
        f"The map now has {report['searchable']} searchable photos "
        f"(vocabulary: {report['vocabulary']})."
    )
    print_failures(report, "missing", "duplicates", "refused", "failed")
