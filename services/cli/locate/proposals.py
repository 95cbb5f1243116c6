"""Proposes positions for the photos of a library, prints them, and writes the accepted ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Column

from placewise.client import Client
from services.cli.client import MapOptions
from services.cli.environment import read_settings
from services.cli.locate.folder import check_time_zones, read_gpx
from services.cli.locate.library import (
    LibraryPhoto,
    LocatedPhoto,
    PhotoLibrary,
    UndoReport,
    WriteReport,
)
from services.cli.locate.preview import (
    Preview,
    SearchedPhoto,
    preview_file,
    read_preview,
    write_preview,
)
from services.cli.output import (
    Json,
    Table,
    TimeZoneOption,
    first_names,
    format_percent,
    print_json,
    print_message,
    print_note,
    print_problem,
    print_table,
    printable_text,
    progress_bar,
)
from shared.errors import PlacewiseError, TooManyRequests, Unavailable
from shared.geotagging.evidence import KnownPosition, TimeNeighbours
from shared.geotagging.locate import (
    SIMILAR_PHOTOS,
    PositionFinder,
    picture_evidence,
    probable_label,
    search_for_position,
)
from shared.tracks.motion import MOTION_MODELS, parse_motion

SEARCHES_AT_ONCE = 4
WITH_COORDINATES = "-90,-180,90,180"  # a box that contains all photos that have some


@dataclass(frozen=True, slots=True)
class LocateOptions:
    """Options of the commands that propose positions."""

    gpx: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GPX track of the trip.", exists=True, dir_okay=False),
    ] = None
    accept: Annotated[
        float, typer.Option(min=0, max=1, help="Probability from which a proposal is accepted.")
    ] = 0.95
    radius: Annotated[
        float,
        typer.Option(min=10, max=2000, help="Radius in metres that the probability is for."),
    ] = 100.0
    motion: Annotated[
        str,
        typer.Option(
            help=f"How the photographer moved: {', '.join(MOTION_MODELS)}, or a maximum speed in "
            "m/s."
        ),
    ] = "walk"
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="The people with the cameras travelled together: photos of all cameras count as "
            "neighbours in time, not only those of the same camera.",
        ),
    ] = False
    time_zone: TimeZoneOption = None
    clock_offset: Annotated[
        float,
        typer.Option(
            metavar="SECONDS", help="How far the clock of the cameras without GPS was ahead."
        ),
    ] = 0.0
    picture: Annotated[
        bool, typer.Option("--picture/--no-picture", help="Search the map with the photos.")
    ] = True


def locate_library(
    library: PhotoLibrary,
    options: LocateOptions,
    common: MapOptions,
    open_client: Callable[[], AbstractContextManager[Client]],
    photos: Sequence[LibraryPhoto] | None = None,
    *,
    write: bool,
    **more_json: Json,
) -> bool:
    """Propose positions for the photos without coordinates, print, and with `write`, write them.

    With `write`, the searches are those that the last call without it has shown.

    Args:
        photos: The library's photos, if they were listed just now.

    Returns:
        Whether all photos could be searched and written.

    Raises:
        InvalidRequest: `unknown_time_zone`, `bad_gpx`, `bad_motion`.
    """
    moves = parse_motion(options.motion)
    photos = library.list_photos() if photos is None else photos
    path = preview_file(
        read_settings().placewise_home, library.identity, common.server, common.map_name
    )
    preview = read_preview(path) if options.picture and write else None
    if options.together:
        check_time_zones(photos, "--together")
    unlocated = [photo for photo in photos if photo.is_unlocated]
    track: Sequence[KnownPosition] = ()
    if options.gpx is not None:
        check_time_zones(unlocated, "--gpx")
        track = read_gpx(options.gpx)
    searches: dict[str, SearchedPhoto] = {}
    if preview is not None:
        found = {photo.name: preview.search_of(photo) for photo in unlocated}
        searches = {name: search for name, search in found.items() if search is not None}
    new = [photo for photo in unlocated if photo.name not in searches] if options.picture else []
    if new:
        with open_client() as client:
            searches |= _search_photos(client, library, new)
    neighbours = TimeNeighbours(photos, options.together)
    finder = PositionFinder(neighbours, track, moves, options.radius)
    located = [_locate_photo(photo, searches.get(photo.name), finder) for photo in unlocated]
    accept_from = max(options.accept, 1e-9)
    accepted = [each for each in located if each.probability >= accept_from]
    written = library.write(accepted) if write else None
    if common.as_json:
        print_json(_to_json(photos, located, options.accept, written) | more_json)
    else:
        _print_proposals(library, options.accept, photos, located, accepted, written)
    if preview is not None:
        _print_changes(preview, located, accepted)
    if new:  # at the end, so that nothing is lost if it can't be written
        now = datetime.now(UTC) if preview is None else preview.searched_at
        entries = {each.name: (each.state, searches[each.name]) for each in unlocated}
        accepted_now = {each.photo.name: each.shown() for each in accepted}
        write_preview(path, Preview(now, entries, accepted_now))
    return not (any(each.error for each in located) or (written is not None and written.skipped))


def _search_photos(
    client: Client, library: PhotoLibrary, photos: Sequence[LibraryPhoto]
) -> dict[str, SearchedPhoto]:
    """Search the map with each photo; returns the searches by name."""
    photo_count = client.stats().searchable_images
    with progress_bar() as progress, ThreadPoolExecutor(SEARCHES_AT_ONCE) as pool:
        searched = progress.track(
            pool.map(partial(_search_photo, client, library, photo_count), photos),
            total=len(photos),
            description="searching",
        )
        return {photo.name: found for photo, found in zip(photos, searched, strict=True)}


def _search_photo(
    client: Client, library: PhotoLibrary, photo_count: int, photo: LibraryPhoto
) -> SearchedPhoto:
    try:
        picture = library.fetch(photo)
    except (Unavailable, TooManyRequests):
        raise
    except PlacewiseError as error:
        return SearchedPhoto(error=error.detail)
    search = partial(client.similar, picture, top_k=SIMILAR_PHOTOS, history=False)
    try:
        answer = search_for_position(
            partial(search, pose=True), partial(search, box=WITH_COORDINATES)
        )
    except PlacewiseError as error:
        if error.status not in (400, 413, 415, 422):  # 400: an empty file
            raise
        return SearchedPhoto(error=error.detail)
    return SearchedPhoto(picture_evidence(answer, photo_count), *probable_label(answer.estimate))


def _locate_photo(
    photo: LibraryPhoto, searched: SearchedPhoto | None, finder: PositionFinder
) -> LocatedPhoto:
    searched = searched or SearchedPhoto()
    proposal, reason = finder.propose(photo, searched.evidence)
    return LocatedPhoto(
        photo, proposal, searched.place, searched.place_probability, searched.error, reason
    )


def _print_changes(
    preview: Preview, located: Sequence[LocatedPhoto], accepted: Sequence[LocatedPhoto]
) -> None:
    """Say of which preview the written proposals are, and which of them it did not show so."""
    shown = preview.accepted
    present = {each.photo.name: each.shown() for each in accepted}
    names = (each.photo.name for each in located)  # not those that were written since
    changed = [name for name in names if shown.get(name) != present.get(name)]
    print_note(
        f"The searches are those of {preview.searched_at.astimezone():%Y-%m-%d %H:%M}; without "
        "--write, the photos are searched again. "
        + (
            f"{len(changed)} proposals are not as they were accepted then, because options, photos "
            f"or the track have changed: {first_names(changed)}"
            if changed
            else "All proposals are as they were then."
        )
    )


def _to_json(
    photos: Sequence[LibraryPhoto],
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
    library: PhotoLibrary,
    accept: float,
    photos: Sequence[LibraryPhoto],
    located: Sequence[LocatedPhoto],
    accepted: Sequence[LocatedPhoto],
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
        position = each.proposal
        table.add_row(
            escape(each.photo.name),
            f"{position.latitude:.6f}" if position else "",
            f"{position.longitude:.6f}" if position else "",
            *([escape(each.place or "")] if any(each.place for each in located) else []),
            f"{position.radius_m:.0f} m" if position else "",
            format_percent(each.probability) if position or each.place else "",
            escape(each.error or (position.reason if position else each.why_unknown)),
            style=None if each in accepted else "dim",
        )
    with_coordinates = sum(photo.latitude is not None for photo in photos)
    for photo in photos:
        if photo.gps_error:
            print_problem("left as it is", photo.name, photo.gps_error)
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
            print_note("Nothing is written. --write writes them.")
        return
    names = printable_text(first_names(written.written))
    print_note(
        f"{len(written.written)} {library.written_are} written{': ' if names else ''}{names}. "
        f"Undo: {library.undo_command}"
    )
    for name, reason in written.skipped.items():
        print_problem("skipped", name, reason)


def report_undo(report: UndoReport, message: str, as_json: bool) -> None:
    """Print what was undone; exits with 1 if something was left as it is."""
    if as_json:
        print_json(asdict(report))
    else:
        print_note(message)
        for name in report.changed_since:
            print_problem("changed since", name, "left as it is")
    if report.changed_since:
        raise typer.Exit(1)
