"""`placewise index`: many photos into the map, from a folder, an archive, a list or a bucket."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from services.cli.client import connect
from services.cli.environment import read_settings
from services.cli.ingest.geotags import LocalPhoto, find_photos, read_photo_manifest
from services.cli.ingest.upload import (
    FitOption,
    UpdateOption,
    UploadJournal,
    check_archive,
    import_keys,
    import_prefix,
    manifest_has_keys,
    upload_archive,
    upload_photos,
)
from services.cli.output import (
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    atomic_write,
    check_output_path,
    err_console,
    print_failures,
    print_json,
    progress_bar,
    report_errors,
)
from shared.catalog.photos import PhotoRole
from shared.client import Json
from shared.errors import InvalidRequest


def index(
    source: Annotated[
        str,
        typer.Argument(
            metavar="DIR|ARCHIVE|MANIFEST.jsonl|s3://BUCKET/PREFIX",
            help="A folder, which is searched recursively; a zip, tar or gzipped tar; a list of "
            "photos, one JSON object a line; or a prefix of the server's own bucket.",
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
    journal: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write down what the server has taken; a run that finds the file sends only the "
            "rest. For DIR and lists of files.",
        ),
    ] = None,
    failures: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.jsonl", help="Write the refused and failed photos with their reasons."
        ),
    ] = None,
    fit: FitOption = True,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Upload every photo of a folder, an archive, a list or a bucket's prefix and wait until all
    are searchable.

    Coordinates come from the CSV or the list, from @UTM@ file names, or from EXIF. Run it again
    after an interruption: what is there already is not described twice. An archive brings its own
    table: photos.csv or manifest.jsonl.
    """
    only_folder = {
        "--csv": table,
        "--utm-zone": utm_zone,
        "--places-by-folder": places,
        "--role": role != PhotoRole.DATABASE,
    }
    of_server = {**only_folder, "--update": update, "--journal": journal}
    with report_errors(as_json):
        if failures is not None:
            check_output_path(failures, ".jsonl", "a list of failures")
        path = Path(source)
        if source.startswith("s3://"):
            _reject_options("a bucket's prefix", of_server)
            with connect(server, map_name, key) as client, progress_bar() as progress:
                report = import_prefix(client, source, fit, progress)
        elif path.is_dir():
            photos = find_photos(path, table, utm_zone, places_by_folder=places)
            if role != PhotoRole.DATABASE:
                photos = [replace(p, fields={**p.fields, "role": role}) for p in photos]
            # Labelled queries teach no vocabulary: they must not start a fit either.
            learns = fit and role == PhotoRole.DATABASE
            report = _upload_photos(photos, learns, update, journal, server, map_name, key)
        elif path.suffix == ".jsonl":
            _reject_options("a list", only_folder)
            data = _read_manifest(path)
            if manifest_has_keys(data):
                _reject_options("a list of keys", of_server)
                with connect(server, map_name, key) as client, progress_bar() as progress:
                    report = import_keys(client, data, fit, progress)
            else:
                photos = read_photo_manifest(path, data)
                report = _upload_photos(photos, fit, update, journal, server, map_name, key)
        else:
            check_archive(path)
            _reject_options("an archive", of_server)
            with connect(server, map_name, key) as client, progress_bar() as progress:
                report = upload_archive(client, path, fit, progress)
        if failures is not None:
            _write_failures(failures, report)
        _finish_command(report, map_name, role, as_json)


def _upload_photos(
    photos: list[LocalPhoto],
    fit: bool,
    update: bool,
    journal: Path | None,
    server: str | None,
    map_name: str | None,
    key: str | None,
) -> Json:
    with (
        connect(server, map_name, key) as client,
        progress_bar() as progress,
        contextlib.ExitStack() as opened,
    ):
        # A server that a command starts for itself has another port each time.
        url = server or str(read_settings().placewise_home.resolve())
        written = opened.enter_context(UploadJournal(journal, url, map_name)) if journal else None
        return upload_photos(client, photos, fit, progress, update=update, journal=written)


def _read_manifest(manifest: Path) -> bytes:
    try:
        return manifest.read_bytes()
    except OSError as error:
        raise InvalidRequest(
            "unreadable_file", f"Can't read {manifest}: {error.strerror}"
        ) from error


def _reject_options(what: str, given: Mapping[str, object]) -> None:
    """InvalidRequest (`not_for_archives`): what the server reads itself takes no options."""
    if wrong := [name for name, value in given.items() if value]:
        raise InvalidRequest(
            "not_for_archives",
            f"{', '.join(wrong)}: not for {what}. Put what is to be said into its table or its "
            "lines; or index a folder.",
        )


def _write_failures(out: Path, report: Json) -> None:
    """One JSON object a line: `outcome`, `path`, `reason`; an empty file where there is none."""
    with atomic_write(out) as file:
        for outcome in ("refused", "failed"):
            for item in report[outcome]:
                file.write(json.dumps({"outcome": outcome, **item}).encode() + b"\n")


def _finish_command(report: Json, map_name: str | None, role: PhotoRole, as_json: bool) -> None:
    if as_json:
        print_json(report)
    else:
        _print_report(report, map_name, role)
    if report["refused"] or report["failed"]:
        raise typer.Exit(1)


def _print_report(report: Json, map_name: str | None, role: PhotoRole) -> None:
    err_console.print(
        f"{report['photos']} photos looked at, {report['already_there']} were there already, "
        f"{report['searchable']} searchable in the map (vocabulary: {report['vocabulary']}).",
        soft_wrap=True,
    )
    print_failures(report, "refused", "failed")
    named = f" --map {map_name}" if map_name else ""
    what = "Ask" if role == PhotoRole.DATABASE else "Evaluate"
    does = "query PHOTO" if role == PhotoRole.DATABASE else "evaluate"
    err_console.print(f"{what}: {sys.argv[0]} {does}{named}", soft_wrap=True)
