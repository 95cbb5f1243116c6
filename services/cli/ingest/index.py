"""`placewise index`: upload photos from folders, archives, a manifest or a bucket prefix."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from operator import methodcaller
from pathlib import Path
from typing import Annotated

import typer

from placewise.answers import BatchStarted
from placewise.client import Client
from placewise.protocol import open_file
from services.cli.client import MapOptions
from services.cli.ingest.anyloc import read_anyloc_photos
from services.cli.ingest.geotags import (
    LocalPhoto,
    LocalSource,
    add_local_headers,
    count_other_files,
    find_local_sources,
    find_photos,
    read_photo_manifest,
)
from services.cli.ingest.upload import (
    NoFitOption,
    UpdateOption,
    manifest_has_keys,
    upload_photos,
    wait_for_batch,
)
from services.cli.output import (
    Json,
    TimeZoneOption,
    print_failures,
    print_json,
    print_note,
    printable_text,
    progress_bar,
)
from shared.enums import PhotoRole
from shared.errors import InvalidRequest
from shared.imaging.file_formats import PHOTO_SUFFIXES

MAX_LISTED_SUFFIXES = 5


def index(
    common: MapOptions,
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE",
            help="Folders (searched recursively), photos and archives (zip, tar, tar.gz); or one "
            "JSONL manifest with one photo per line; or one prefix of the server's own bucket.",
        ),
    ],
    table: Annotated[
        Path | None,
        typer.Option(
            "--csv",
            help="CSV table with the columns filename, latitude, longitude, altitude, heading, "
            "captured_at, place and tags. filename is relative to the folder or archive; the other "
            "columns are optional.",
        ),
    ] = None,
    anyloc: Annotated[
        Path | None,
        typer.Option(
            metavar="similarity.db",
            exists=True,
            dir_okay=False,
            help="Database of an AnyLoc similarity service, with the names, tags and metadata of "
            "the photos in its folder of uploads, which is SOURCE.",
        ),
    ] = None,
    utm_zone: Annotated[
        str | None,
        typer.Option(help="UTM zone of @UTM@ file names that don't contain it, such as 32T."),
    ] = None,
    time_zone: TimeZoneOption = None,
    places: Annotated[
        bool,
        typer.Option(
            "--places-by-folder",
            help="Use the name of a photo's folder as its place label (rooms, shelves, trails).",
        ),
    ] = False,
    role: Annotated[
        PhotoRole,
        typer.Option(help="`query` uploads labelled queries for `placewise evaluate`."),
    ] = PhotoRole.DATABASE,
    update: UpdateOption = False,
    no_fit: NoFitOption = False,
) -> None:
    """Upload photos and wait until they are searchable.

    Coordinates are read from the CSV table or manifest, from @UTM@ file names, from EXIF or XMP in
    the photo, or from its sidecar (IMG_1.jpg.xmp, IMG_1.xmp, or the JSON of Google Takeout). An
    archive may contain its own table: photos.csv or manifest.jsonl. The command is idempotent: run
    it again after an interruption.
    """
    folder_options = {
        "--csv": table,
        "--utm-zone": utm_zone,
        "--time-zone": time_zone,
        "--places-by-folder": places,
        "--role": role != PhotoRole.DATABASE,
    }
    local_file_options = {**folder_options, "--anyloc": anyloc, "--update": update}
    source, path = sources[0], Path(sources[0])
    photos: list[LocalPhoto] = []
    batch: Callable[[Client], BatchStarted] | None = None  # of objects that the server has
    with contextlib.ExitStack() as stack:
        opened: list[LocalSource] = []
        about_sources: Json = {}
        local = find_local_sources(sources)
        if anyloc is not None:
            _reject_options("photos of an AnyLoc service", folder_options)
            if len(sources) > 1 or not path.is_dir():
                _reject_options("anything but one existing folder", {"--anyloc": anyloc})
            found = read_anyloc_photos(anyloc, path)
            photos = found.photos
            about_sources = {k: v for k, v in asdict(found).items() if k != "photos"}
        elif local is not None:
            if len(local) > 1 or path.suffix.lower() in PHOTO_SUFFIXES:
                _reject_options("photos and several folders", {"--csv": table})
            opened = [LocalSource.open(each, stack) for each in local]
            for each in opened:
                photos += find_photos(
                    each.path, table, utm_zone, own_table=each.table, places_by_folder=places
                )
            if role != PhotoRole.DATABASE:
                photos = [replace(p, fields={**p.fields, "role": role}) for p in photos]
        elif len(sources) > 1:
            raise InvalidRequest(
                "several_sources",
                f"{source} and {len(sources) - 1} more: index manifests and bucket prefixes one at "
                "a time. Only existing folders, photos and archives can be combined.",
            )
        elif source.startswith("s3://"):
            _reject_options("a bucket prefix", local_file_options)
            batch = methodcaller("import_prefix", source)
        elif path.suffix == ".jsonl":
            _reject_options("a manifest", folder_options)
            with open_file(path) as file:
                data = file.read()
            if manifest_has_keys(data):
                _reject_options("a manifest of object keys", local_file_options)
                batch = methodcaller("import_objects", data)
            else:
                photos = read_photo_manifest(path, data)
        else:
            with open_file(path):  # says why a file can't be read
                raise InvalidRequest(
                    "unsupported_source",
                    f"{path} is not a folder or a photo, and not a complete zip or tar. If it is "
                    "an archive, download or create it again. Photos end with "
                    f"{', '.join(sorted(PHOTO_SUFFIXES))}.",
                )
        if photos and anyloc is None:
            photos, headers = add_local_headers(photos, time_zone)
            sidecars = {path for photo in photos for path in photo.sidecars}
            read = Counter(each.table.suffix for each in opened if each.table)
            read.update(Path(path).suffix.lower() for path in sidecars)
            others = sum((count_other_files(each.path) for each in opened), Counter[str]()) - read
            about_sources = {
                "other_files": others.total(),
                "other_suffixes": dict(others.most_common()),
                "sidecars": len(sidecars),
                **asdict(headers),
            }
        client = stack.enter_context(common.connect())
        progress = stack.enter_context(progress_bar())
        print_note(f"Indexing into {common.describe_target(client)}")
        if no_fit:
            client.update_map(client.stats().map, auto_fit=False)
        if batch is not None:
            report = wait_for_batch(client, batch(client), progress)
        else:
            report = upload_photos(client, photos, progress, update=update)
    report |= about_sources
    if common.as_json:
        print_json(report)
    else:
        _print_report(report, common, role)
    if report["refused"] or report["failed"] or report.get("missing"):
        raise typer.Exit(1)


def _reject_options(source: str, options: Mapping[str, object]) -> None:
    """Raise InvalidRequest (`unsupported_option`) if an option does not apply to this source."""
    if invalid := [name for name, value in options.items() if value]:
        raise InvalidRequest(
            "unsupported_option",
            f"{', '.join(invalid)}: not supported for {source}. Put the metadata into its table or "
            "manifest, or index a folder.",
        )


def _list_suffixes(report: Json) -> str:
    """Name the most frequent kinds of skipped files: ` (12 .mov, 3 .dng)`."""
    kinds = [
        f"{number} {suffix or 'without an ending'}"
        for suffix, number in report["other_suffixes"].items()
    ]
    shown = kinds[:MAX_LISTED_SUFFIXES] + ["..."] * (len(kinds) > MAX_LISTED_SUFFIXES)
    return f" ({', '.join(shown)})" if kinds else ""


def _print_report(report: Json, common: MapOptions, role: PhotoRole) -> None:
    print_note(
        f"{report['photos']} photos processed, {report['already_there']} already stored. "
        f"The map now has {report['searchable']} searchable photos "
        f"(vocabulary: {report['vocabulary']})."
    )
    if "rows" in report:
        print_note(f"{report['rows']} database rows, {report['unlisted']} photos without one.")
        print_failures(report, "missing", "duplicates")
    if report.get("updated"):
        print_note(
            f"{_count(report['updated'], 'photo')} updated: the map has the same picture, and the "
            "file has new metadata."
        )
    if report.get("other_files") or report.get("without_coordinates"):
        print_note(
            f"{_count(report['other_files'], 'other file')} skipped{_list_suffixes(report)}, "
            f"{_count(report['without_coordinates'], 'photo')} without coordinates."
        )
    if report.get("sidecars"):
        print_note(f"{_count(report['sidecars'], 'sidecar')} read.")
    if report.get("without_time_zone"):
        print_note(
            f"{_count(report['without_time_zone'], 'photo')} with a time but no time zone: the "
            "time is taken as UTC. Pass the zone: --time-zone +02:00 or --time-zone Europe/Paris."
        )
    if report.get("not_understood"):
        number = _count(len(report["not_understood"]), "photo")
        print_note(f"{number} with a GPS tag that could not be read:")
        for item in report["not_understood"]:
            print_note(f"{printable_text(item['path'])}: {item['reason']}")
    print_failures(report, "refused", "failed")
    command = ("query", "PHOTO") if role == PhotoRole.DATABASE else ("evaluate",)
    print_note(f"Next: {common.command_line(*command)}")


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
