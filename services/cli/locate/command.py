"""`placewise locate`: propose where the photos of a folder were taken that have no coordinates."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Column

from placewise.answers import Similar
from placewise.client import Client
from services.cli.client import connect
from services.cli.locate.folder import FolderPhoto, check_time_zones, read_folder, read_gpx
from services.cli.locate.undo_journal import UndoReport, undo
from services.cli.locate.writers import Location, Target, WriteReport, write_locations
from services.cli.output import (
    Json,
    JsonOption,
    KeyOption,
    MapOption,
    ServerOption,
    Table,
    err_console,
    format_percent,
    print_json,
    print_message,
    print_note,
    print_table,
    printable_path,
    progress_bar,
)
from shared.errors import PlacewiseError
from shared.evaluation.places.probability import OUT_OF_MAP_SHARE
from shared.geotagging.evidence import (
    KnownPosition,
    PictureEvidence,
    ProbableCircle,
    SimilarPosition,
    TimeNeighbours,
    interpolate_position,
)
from shared.geotagging.fusion import Proposal, propose_position
from shared.tracks.motion import MOTION_MODELS, MotionModel, parse_motion

SIMILAR_PHOTOS = 50
SEARCHES_AT_ONCE = 4
WITH_COORDINATES = "-90,-180,90,180"  # a box that contains all photos that have some


@dataclass(frozen=True, slots=True)
class _LocatedPhoto:
    """The proposal for a photo without coordinates."""

    photo: FolderPhoto
    proposal: Proposal | None
    place: str | None
    """finest label of the estimate"""
    place_probability: float | None
    error: str | None
    """why the photo could not be searched"""

    @property
    def probability(self) -> float:
        """Of the position, or of the place if there is none."""
        if self.proposal is not None:
            return self.proposal.probability
        return self.place_probability or 0.0


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
    time_zone: Annotated[
        str | None,
        typer.Option(
            metavar="ZONE",
            help="Time zone of photos whose EXIF has none, such as +02:00 or Europe/Paris.",
        ),
    ] = None,
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
    if together:
        check_time_zones(photos, "--together")
    track: Sequence[KnownPosition] = ()
    if gpx is not None:
        check_time_zones([p for p in photos if p.latitude is None], "--gpx")
        track = read_gpx(gpx)
    unlocated = [photo for photo in photos if photo.latitude is None]
    searches: Sequence[Similar | str | None] = [None] * len(unlocated)
    photo_count = 0
    if picture and unlocated:
        with connect(server, map_name, key) as client:
            photo_count = client.stats().searchable_images
            searches = _search_photos(client, unlocated)
    neighbours = TimeNeighbours(photos, together)
    located = [
        _locate_photo(photo, search, photo_count, neighbours, track, moves, radius)
        for photo, search in zip(unlocated, searches, strict=True)
    ]
    accept_from = max(accept, 1e-9)
    accepted = [each for each in located if each.probability >= accept_from]
    written = None
    if write is not None:
        written = write_locations(
            folder, write, [_location(each, accept_from) for each in accepted]
        )
    if as_json:
        print_json(_to_json(photos, located, accept, written))
    else:
        _print_proposals(folder, photos, located, accepted, accept, written)
    if any(each.error for each in located) or (written is not None and written.skipped):
        raise typer.Exit(1)


def _search_photos(client: Client, photos: Sequence[FolderPhoto]) -> list[Similar | str]:
    """Search the map with each photo; the reason for those that can't be searched with."""
    with progress_bar() as progress, ThreadPoolExecutor(SEARCHES_AT_ONCE) as pool:
        return list(
            progress.track(
                pool.map(partial(_search_photo, client), photos),
                total=len(photos),
                description="searching",
            )
        )


def _search_photo(client: Client, photo: FolderPhoto) -> Similar | str:
    try:
        answer = client.similar(photo.path, top_k=SIMILAR_PHOTOS)
        first = answer.similar_images[0] if answer.similar_images else None
        if first is not None and first.latitude is None and first.place is None:
            # Photos of the map without coordinates, such as this one, hide those that have some.
            return client.similar(photo.path, top_k=SIMILAR_PHOTOS, box=WITH_COORDINATES)
    except PlacewiseError as error:
        if error.status not in (400, 413, 415, 422):  # 400: an empty file
            raise
        return error.detail
    return answer


def _locate_photo(
    photo: FolderPhoto,
    search: Similar | str | None,
    photo_count: int,
    neighbours: TimeNeighbours,
    track: Sequence[KnownPosition],
    moves: MotionModel,
    radius_m: float,
) -> _LocatedPhoto:
    speed = moves.max_speed_mps
    on_track = None if photo.time is None else interpolate_position(track, photo.time, speed)
    answer = search if isinstance(search, Similar) else None
    evidence = None if answer is None else picture_evidence(answer, photo_count)
    label = next((each for each in answer.estimate.levels if each.place), None) if answer else None
    return _LocatedPhoto(
        photo,
        propose_position(evidence, neighbours.position_of(photo, speed), on_track, radius_m),
        label.place if label else None,
        label.probability if label else None,
        search if isinstance(search, str) else None,
    )


def picture_evidence(answer: Similar, photo_count: int) -> PictureEvidence:
    """Return what a search says about the position.

    Args:
        answer: The response.
        photo_count: Number of photos of the map.
    """
    estimate = answer.estimate
    missing = estimate.not_in_map_probability
    return PictureEvidence(
        [
            SimilarPosition(
                photo.latitude,
                photo.longitude,
                photo.similarity_score if photo.weighted_score is None else photo.weighted_score,
                photo.relative_path or photo.original_filename,
            )
            for photo in answer.similar_images
            if photo.latitude is not None and photo.longitude is not None
        ],
        [
            ProbableCircle(level.latitude, level.longitude, level.radius_m, level.probability)
            for level in estimate.levels
            if level.latitude is not None
            and level.longitude is not None
            and level.radius_m is not None
        ],
        OUT_OF_MAP_SHARE if missing is None else missing,
        photo_count,
    )


def _location(located: _LocatedPhoto, accept: float) -> Location:
    """Return what is written of an accepted proposal: its place only if that is accepted, too."""
    photo = located.photo
    return Location(
        photo.path,
        photo.name,
        photo.time if photo.time_zone_is_known else None,
        located.proposal,
        located.place if (located.place_probability or 0.0) >= accept else None,
    )


def _to_json(
    photos: Sequence[FolderPhoto],
    located: Sequence[_LocatedPhoto],
    accept: float,
    written: WriteReport | None,
) -> Json:
    return {
        "photos": len(photos),
        "with_coordinates": len(photos) - len(located),
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
                "error": each.error,
            }
            for each in located
        ],
        "written": asdict(written) if written else None,
    }


def _print_proposals(
    folder: Path,
    photos: Sequence[FolderPhoto],
    located: Sequence[_LocatedPhoto],
    accepted: Sequence[_LocatedPhoto],
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
            escape(each.error or (found.reason if found else "nothing is known about its place")),
            style=None if each in accepted else "dim",
        )
    if not located:
        print_message(f"All {len(photos)} photos have coordinates: there is nothing to locate.")
        return
    print_table(table)
    print_message(
        f"{len(photos) - len(located)} of {len(photos)} photos have coordinates; "
        f"{len(accepted)} of the {len(located)} others have a proposal with at least "
        f"{100 * accept:g} %."
    )
    if written is None:
        if accepted:
            print_note("Nothing is written. --write sidecar, exif, csv or gpx writes them.")
        return
    names = ", ".join(written.written[:3]) + (" ..." if len(written.written) > 3 else "")
    print_note(
        f"{len(written.written)} files written{': ' if names else ''}{names}. "
        f"Undo: {sys.argv[0]} locate {printable_path(folder)} --undo"
    )
    for name, reason in written.skipped.items():
        err_console.print(f"[red]skipped[/red] {escape(name)}: {escape(reason)}", soft_wrap=True)


def _report_undo(report: UndoReport, as_json: bool) -> None:
    if as_json:
        print_json(asdict(report))
    else:
        print_note(f"{len(report.restored)} files restored, {len(report.removed)} removed.")
        for name in report.changed_since:
            err_console.print(
                f"[red]changed since[/red] {escape(name)}: left as it is", soft_wrap=True
            )
    if report.changed_since:
        raise typer.Exit(1)
