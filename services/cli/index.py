"""`placewise index DIR` or `placewise index ARCHIVE`: many photos into the map."""

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
    print_faults,
    print_json,
    progress_bar,
)
from services.cli.photo_places import find_photos
from services.cli.upload_archive import check_archive, upload_archive
from services.cli.upload_many import FitOption, UpdateOption, upload_many
from shared.catalog.photos import PhotoRole
from shared.client import Json
from shared.errors import InvalidRequest


def index(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR|ARCHIVE",
            exists=True,
            help="A folder, which is searched recursively; or a zip, tar or gzipped tar.",
        ),
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
    """Upload every photo of a folder or an archive and wait until all are searchable.

    Coordinates come from the CSV, from @UTM@ file names, or from EXIF. Run it again after an
    interruption: what is there already is not described twice. An archive brings its own table:
    photos.csv or manifest.jsonl.
    """
    with explained(as_json):
        if folder.is_file():
            check_archive(folder)
            _check_options(table, utm_zone, places, role, update)
            with connect(server, map_name, key) as client, progress_bar() as progress:
                report = upload_archive(client, folder, fit, progress)
            _end(report, map_name, role, as_json)
            return
        photos = find_photos(folder, table, utm_zone, places_by_folder=places)
        if role != PhotoRole.DATABASE:
            photos = [replace(p, fields={**p.fields, "role": role}) for p in photos]
        with connect(server, map_name, key) as client, progress_bar() as progress:
            # Labelled queries teach no vocabulary: they must not start a fit either.
            learns = fit and role == PhotoRole.DATABASE
            report = upload_many(client, photos, learns, progress, update=update)
        _end(report, map_name, role, as_json)


def _check_options(
    table: Path | None, utm_zone: str | None, places: bool, role: PhotoRole, update: bool
) -> None:
    """An archive is read by the server, which knows of no options."""
    given = {
        "--csv": table,
        "--utm-zone": utm_zone,
        "--places-by-folder": places,
        "--role": role != PhotoRole.DATABASE,
        "--update": update,
    }
    if wrong := [name for name, value in given.items() if value]:
        raise InvalidRequest(
            "not_for_archives",
            f"{', '.join(wrong)}: only for folders. Put what is to be said into the archive, as "
            "photos.csv or manifest.jsonl; or unpack it and index the folder.",
        )


def _end(report: Json, map_name: str | None, role: PhotoRole, as_json: bool) -> None:
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
