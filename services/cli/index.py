"""`placewise index DIR`: a folder of photos into the map."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from services.cli.connect import connect
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    explained,
    messages,
    print_json,
    progress_bar,
)
from services.cli.photo_places import find_photos
from services.cli.upload_many import FitOption, UpdateOption, print_faults, upload_many
from shared.catalog.photos import PhotoRole
from shared.client import Json


def index(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", exists=True, file_okay=False, help="Searched recursively."),
    ],
    table: Annotated[
        Path | None,
        typer.Option(
            "--csv",
            help="Columns: filename (below DIR), and any of latitude, longitude, heading, "
            "captured_at, place, tags.",
        ),
    ] = None,
    utm_zone: Annotated[
        str | None,
        typer.Option(help="Zone of @UTM@ names that don't say it, such as 32T."),
    ] = None,
    places: Annotated[
        bool,
        typer.Option(
            "--places-by-folder",
            help="The name of a photo's folder is its place label: for rooms, shelves, trails.",
        ),
    ] = False,
    role: Annotated[
        PhotoRole,
        typer.Option(help="`query`: labelled queries, which `placewise evaluate` asks with."),
    ] = PhotoRole.DATABASE,
    update: UpdateOption = False,
    fit: FitOption = True,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Upload every photo of a folder and wait until all are searchable.

    Coordinates come from the CSV, from @UTM@ file names, or from EXIF. Run it again after an
    interruption: what is there already is not described twice.
    """
    with explained(as_json):
        photos = find_photos(folder, table, utm_zone, places_by_folder=places)
        if role != PhotoRole.DATABASE:
            photos = [replace(p, fields={**p.fields, "role": role}) for p in photos]
        with connect(server, map_name, key) as client, progress_bar() as progress:
            # Labelled queries teach no vocabulary: they must not start a fit either.
            learns = fit and role == PhotoRole.DATABASE
            report = upload_many(client, photos, learns, progress, update=update)
        if as_json:
            print_json(report)
        else:
            _print(report, map_name, role)
        if report["refused"] or report["failed"]:
            raise typer.Exit(1)


def _print(report: Json, map_name: str | None, role: PhotoRole) -> None:
    messages.print(
        f"{report['photos']} photos looked at, {report['already_there']} were there already, "
        f"{report['searchable']} searchable in the map (vocabulary: {report['vocabulary']}).",
        soft_wrap=True,
    )
    print_faults(report, "refused", "failed")
    named = f" --map {map_name}" if map_name else ""
    what = "Ask" if role == PhotoRole.DATABASE else "Evaluate"
    does = "query PHOTO" if role == PhotoRole.DATABASE else "evaluate"
    messages.print(f"{what}: {sys.argv[0]} {does}{named}", soft_wrap=True)
