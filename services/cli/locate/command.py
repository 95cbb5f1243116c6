"""`placewise locate`: propose where the photos of a folder were taken that have no coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Column

from placewise.client import Client
from services.cli.client import connect
from services.cli.environment import read_settings
from services.cli.locate.folder import FolderPhoto, check_time_zones, read_folder, read_gpx
from services.cli.locate.preview import (
    Preview,
    SearchedPhoto,
    file_state,
    preview_file,
    read_preview,
    write_preview,
)
from services.cli.locate.undo_journal import UndoReport, undo
from services.cli.locate.writers import LocatedPhoto, Target, WriteReport, write_locations
from services.cli.output import (
    Json,
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    Table,
    TimeZoneOption,
    err_console,
    format_percent,
    print_json,
    print_message,
    print_note,
    print_table,
    printable_text,
    progress_bar,
)
from shared.config.command_line import command_line
from shared.errors import PlacewiseError
from shared.geotagging.evidence import KnownPosition, TimeNeighbours
from shared.geotagging.locate import (
    SIMILAR_PHOTOS,
    PositionFinder,
    picture_evidence,
    probable_label,
)
from shared.tracks.motion import MOTION_MODELS, parse_motion

SEARCHES_AT_ONCE = 4
WITH_COORDINATES = "-90,-180,90,180"  # a box that contains all photos that have some


def locate(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            exists=True,
            file_okay=False,
            help="A folder of photos, searched recursively.",
        ),
    ],
    gpx: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GPX track of the trip.", exists=True, dir_okay=False),
    ] = None,
    accept: Annotated[
        float,
        typer.Option(min=0, max=1, help="Probability from which a proposal is accepted."),
    ] = 0.95,
    radius: Annotated[
        float,
        typer.Option(min=10, max=2000, help="Radius in metres that the probability is for."),
    ] = 100.0,
    write: Annotated[
        Target | None,
        typer.Option(
            help="Write the accepted proposals: XMP sidecars, EXIF, or a CSV table or GPX "
            "waypoints in DIR. Without it, nothing is written.",
        ),
    ] = None,
    undo_changes: Annotated[
        bool,
        typer.Option("--undo", help="Restore all files that --write has changed in DIR."),
    ] = False,
    motion: Annotated[
        str,
        typer.Option(
            help=f"How the photographer moved: {', '.join(MOTION_MODELS)}, or a maximum speed in "
            "m/s."
        ),
    ] = "walk",
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="The people with the cameras travelled together: photos of all cameras count as "
            "neighbours in time, not only those of the same camera.",
        ),
    ] = False,
    time_zone: TimeZoneOption = None,
    clock_offset: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            help="How far the clock of the cameras without GPS was ahead.",
        ),
    ] = 0.0,
    picture: Annotated[
        bool,
        typer.Option("--picture/--no-picture", help="Search the map with the photos."),
    ] = True,
    map_name: MapOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Propose where the photos in DIR were taken that have no coordinates.

    A proposal combines the photos of the map that look similar, photos of the same camera that were
    taken shortly before and after and have coordinates, and a GPX track. Coordinates that a photo
    has are never changed.
    """
    if undo_changes:
        _report_undo(undo(folder), as_json)
        return
    moves = parse_motion(motion)
    photos = read_folder(folder, time_zone, clock_offset)
    preview_path = preview_file(read_settings().placewise_home, folder, server, map_name)
    preview = read_preview(preview_path) if picture and write is not None else None
    if together:
        check_time_zones(photos, "--together")
    track: Sequence[KnownPosition] = ()
    if gpx is not None:
        check_time_zones([p for p in photos if p.is_unlocated], "--gpx")
        track = read_gpx(gpx)
    unlocated = [photo for photo in photos if photo.is_unlocated]
    states = {photo.path: file_state(photo.path) for photo in unlocated}
    searches: dict[Path, SearchedPhoto] = {}
    if preview is not None:
        found = {photo.path: preview.search_of(photo.name, photo.path) for photo in unlocated}
        searches = {path: search for path, search in found.items() if search is not None}
    new = [photo for photo in unlocated if photo.path not in searches] if picture else []
    if new:
        with connect(server, map_name, key) as client:
            searches |= _search_photos(client, client.stats().searchable_images, new)
    finder = PositionFinder(TimeNeighbours(photos, together), track, moves, radius)
    located = [_locate_photo(photo, searches.get(photo.path), finder) for photo in unlocated]
    accept_from = max(accept, 1e-9)
    accepted = [each for each in located if each.probability >= accept_from]
    written = None
    if write is not None:
        # A place is written only if it is accepted, too.
        located_surely = [
            each if (each.place_probability or 0.0) >= accept_from else replace(each, place=None)
            for each in accepted
        ]
        written = write_locations(folder, write, located_surely)
    if as_json:
        print_json(_to_json(photos, located, accept, written))
    else:
        _print_proposals(folder, photos, located, accepted, accept, written)
    if preview is not None:
        _print_changes(preview, accepted)
    if new:  # at the end, so that nothing is lost if it can't be written
        now = datetime.now(UTC) if preview is None else preview.searched_at
        entries = {each.name: (*states[each.path], searches[each.path]) for each in unlocated}
        accepted_now = {each.photo.name: each.shown() for each in accepted}
        write_preview(preview_path, Preview(now, entries, accepted_now))
    if any(each.error for each in located) or (written is not None and written.skipped):
        raise typer.Exit(1)


def _search_photos(
    client: Client, photo_count: int, photos: Sequence[FolderPhoto]
) -> dict[Path, SearchedPhoto]:
    """Search the map, which has so many photos, with each photo."""
    with progress_bar() as progress, ThreadPoolExecutor(SEARCHES_AT_ONCE) as pool:
        searched = progress.track(
            pool.map(partial(_search_photo, client, photo_count), photos),
            total=len(photos),
            description="searching",
        )
        return {photo.path: found for photo, found in zip(photos, searched, strict=True)}


def _search_photo(client: Client, photo_count: int, photo: FolderPhoto) -> SearchedPhoto:
    try:
        answer = client.similar(photo.path, top_k=SIMILAR_PHOTOS, pose=True, history=False)
        if answer.matches_without_place:  # they hide photos with coordinates
            located = client.similar(
                photo.path, top_k=SIMILAR_PHOTOS, box=WITH_COORDINATES, history=False
            )
            answer = answer.model_copy(update={"similar_images": located.similar_images})
    except PlacewiseError as error:
        if error.status not in (400, 413, 415, 422):  # 400: an empty file
            raise
        return SearchedPhoto(error=error.detail)
    return SearchedPhoto(picture_evidence(answer, photo_count), *probable_label(answer.estimate))


def _locate_photo(
    photo: FolderPhoto, searched: SearchedPhoto | None, finder: PositionFinder
) -> LocatedPhoto:
    searched = searched or SearchedPhoto()
    proposal, reason = finder.propose(photo, searched.evidence)
    return LocatedPhoto(
        photo, proposal, searched.place, searched.place_probability, searched.error, reason
    )


def _print_changes(preview: Preview, accepted: Sequence[LocatedPhoto]) -> None:
    """Say of which preview the written proposals are, and which of them it did not show so."""
    shown = preview.accepted
    present = {each.photo.name: each.shown() for each in accepted}
    changed = [name for name in {**shown, **present} if shown.get(name) != present.get(name)]
    print_note(
        f"The searches are those of {preview.searched_at.astimezone():%Y-%m-%d %H:%M}; without "
        "--write, the photos are searched again. "
        + (
            f"{len(changed)} proposals are not as they were accepted then, because options, photos "
            f"or the track have changed: {', '.join(changed[:3])}"
            + (" ..." if len(changed) > 3 else "")
            if changed
            else "All proposals are as they were then."
        )
    )


def _to_json(
    photos: Sequence[FolderPhoto],
    located: Sequence[LocatedPhoto],
    accept: float,
    written: WriteReport | None,
) -> Json:
    return {
        "photos": len(photos),
        "with_coordinates": sum(photo.latitude is not None for photo in photos),
        "not_understood": [
            {"filename": photo.name, "reason": photo.gps_error}
            for photo in photos
            if photo.gps_error
        ],
        "accept": accept,
        "proposals": [
            {
                "filename": each.photo.name,
                "captured_at": each.photo.time.isoformat() if each.photo.time else None,
                "time_zone_is_known": each.photo.time_zone_is_known,
                "accepted": each.probability >= max(accept, 1e-9),
                "position": asdict(each.proposal) if each.proposal else None,
                "place": each.place,
                "place_probability": each.place_probability,
                "why_unknown": None if each.proposal else each.why_unknown,
                "error": each.error,
            }
            for each in located
        ],
        "written": asdict(written) if written else None,
    }


def _print_proposals(
    folder: Path,
    photos: Sequence[FolderPhoto],
    located: Sequence[LocatedPhoto],
    accepted: Sequence[LocatedPhoto],
    accept: float,
    written: WriteReport | None,
) -> None:
    table = Table(
        "photo",
        Column("latitude", no_wrap=True),
        Column("longitude", no_wrap=True),
        *(["place"] if any(each.place for each in located) else []),
        Column("within", justify="right", no_wrap=True),
        Column("prob.", justify="right", no_wrap=True),
        "reason",
    )
    for each in located:
        found = each.proposal
        table.add_row(
            escape(each.photo.name),
            f"{found.latitude:.6f}" if found else "",
            f"{found.longitude:.6f}" if found else "",
            *([escape(each.place or "")] if any(each.place for each in located) else []),
            f"{found.radius_m:.0f} m" if found else "",
            format_percent(each.probability) if found or each.place else "",
            escape(each.error or (found.reason if found else each.why_unknown)),
            style=None if each in accepted else "dim",
        )
    with_coordinates = sum(photo.latitude is not None for photo in photos)
    for photo in photos:
        if photo.gps_error:
            line = f"{printable_text(photo.name)}: {photo.gps_error}"
            err_console.print(f"[red]left as it is[/red] {escape(line)}", soft_wrap=True)
    if not located:
        print_message(
            f"{with_coordinates} of {len(photos)} photos have coordinates: there is nothing to "
            "locate."
        )
        return
    print_table(table)
    print_message(
        f"{with_coordinates} of {len(photos)} photos have coordinates; "
        f"{len(accepted)} of the {len(located)} others have a proposal with at least "
        f"{100 * accept:g} %."
    )
    without_zone = sum(p.time is not None and not p.time_zone_is_known for p in photos)
    if without_zone:
        print_note(
            f"The clocks of {without_zone} photos have no time zone, so that they are compared "
            "with one another only. Pass it: --time-zone +02:00 or --time-zone Europe/Paris."
        )
    if written is None:
        if accepted:
            print_note("Nothing is written. --write sidecar, exif, csv or gpx writes them.")
        return
    names = ", ".join(map(printable_text, written.written[:3])) + (
        " ..." if len(written.written) > 3 else ""
    )
    print_note(
        f"{len(written.written)} files written{': ' if names else ''}{names}. "
        f"Undo: {command_line('locate', folder, '--undo')}"
    )
    for name, reason in written.skipped.items():
        line = f"[red]skipped[/red] {escape(printable_text(name))}: {escape(reason)}"
        err_console.print(line, soft_wrap=True)


def _report_undo(report: UndoReport, as_json: bool) -> None:
    if as_json:
        print_json(asdict(report))
    else:
        print_note(f"{len(report.restored)} files restored, {len(report.removed)} removed.")
        for name in report.changed_since:
            err_console.print(
                f"[red]changed since[/red] {escape(printable_text(name))}: left as it is",
                soft_wrap=True,
            )
    if report.changed_since:
        raise typer.Exit(1)
