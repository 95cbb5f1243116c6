"""`placewise index DIR`: a folder of photos into the map."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import Progress

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
    shown,
)
from services.cli.photo_places import FoundPhoto, find_photos
from services.cli.vocabulary import fit_and_wait
from shared.client import FINISHED, Client, Json, retry_while_away
from shared.errors import PlacewiseError

FIT_FROM_PHOTOS = 50
UPLOADS_AT_ONCE = 4
AWAY_SECONDS = 60.0
LOOK_SECONDS = 1.0  # a job that begins to wait for a vocabulary is not seen by a longer poll


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
    fit: Annotated[
        bool,
        typer.Option(
            "--fit/--no-fit",
            help=f"Fit a vocabulary at the end, from {FIT_FROM_PHOTOS} photos up, if the map has "
            "none of its own.",
        ),
    ] = True,
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
        photos = find_photos(folder, table, utm_zone)
        with connect(server, map_name, key) as client, progress_bar() as progress:
            report = _index(client, photos, fit, progress)
        if as_json:
            print_json(report)
        else:
            _print(report)
        if report["refused"] or report["failed"]:
            raise typer.Exit(1)


def _index(client: Client, photos: list[FoundPhoto], fit: bool, progress: Progress) -> Json:
    client.stats()  # a wrong address or map is said once and now, not after each photo
    counts: Counter[str] = Counter()
    refused: list[Json] = []
    failed: list[Json] = []
    pending: list[tuple[Path, str]] = []
    uploading = progress.add_task("uploading", total=len(photos))
    for photo, outcome in _upload_all(client, photos):
        progress.advance(uploading)
        if isinstance(outcome, PlacewiseError):
            refused.append({"path": shown(photo.path), "reason": outcome.detail})
            continue
        counts[outcome["status"]] += 1
        if outcome["status"] not in FINISHED:
            pending.append((photo.path, outcome["job_id"]))
    describing = progress.add_task("describing", total=len(pending))
    pending = _wait_all(client, pending, failed, progress, describing)

    stats = client.stats()
    vocabulary: Json | None = None
    if (
        fit
        and stats["vocabulary"] in ("foreign", None)
        and stats["total_images"] >= FIT_FROM_PHOTOS
    ):
        vocabulary = fit_and_wait(client, {}, progress)
        stats = client.stats()
    _wait_all(client, pending, failed, progress, describing)
    return {
        "photos": len(photos),
        "already_there": counts["succeeded"],
        "searchable": stats["searchable_images"],
        "refused": refused,
        "failed": failed,
        "vocabulary": stats["vocabulary"],
        "fitted": vocabulary,
    }


def _upload_all(
    client: Client, photos: list[FoundPhoto]
) -> Iterator[tuple[FoundPhoto, Json | PlacewiseError]]:
    def upload(photo: FoundPhoto) -> Json | PlacewiseError:
        fields: dict[str, Any] = dict(photo.fields)
        try:
            return retry_while_away(lambda: client.upload(photo.path, **fields), AWAY_SECONDS)
        except PlacewiseError as error:
            return error

    with ThreadPoolExecutor(UPLOADS_AT_ONCE) as pool:
        yield from zip(photos, pool.map(upload, photos), strict=True)


def _wait_all(
    client: Client,
    pending: list[tuple[Path, str]],
    failed: list[Json],
    progress: Progress,
    bar: Any,
) -> list[tuple[Path, str]]:
    """Wait for the jobs; returns those that wait for a vocabulary and can't end before it."""
    waiting: list[tuple[Path, str]] = []
    for path, job_id in pending:
        wait_seconds = 0.0
        while True:
            job = client.job(job_id, wait_seconds)
            wait_seconds = LOOK_SECONDS
            if job["state"] in FINISHED:
                progress.advance(bar)
                if job["state"] != "succeeded":
                    reason = (job["error"] or {}).get("detail", job["state"])
                    failed.append({"path": shown(path), "reason": reason})
                break
            if job["waiting_for"]:
                waiting.append((path, job_id))
                break
    return waiting


def _print(report: Json) -> None:
    messages.print(
        f"{report['photos']} photos looked at, {report['already_there']} were there already, "
        f"{report['searchable']} searchable in the map (vocabulary: {report['vocabulary']}).",
        soft_wrap=True,
    )
    for word in ("refused", "failed"):
        if report[word]:
            messages.print(f"{len(report[word])} {word}:")
        for item in report[word]:
            messages.print(f"[red]{word}[/red] {item['path']}: {item['reason']}", soft_wrap=True)
    messages.print(f"Ask: {sys.argv[0]} query PHOTO")
