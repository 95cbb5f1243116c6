"""Proposes positions for the photos of a library, and writes those that are accepted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial

from placewise.answers import CameraPose, Similar
from placewise.client import Client
from services.cli.environment import read_settings
from services.cli.locate.folder import check_time_zones, read_gpx
from services.cli.locate.library import LibraryPhoto, LocatedPhoto, PhotoLibrary
from services.cli.locate.preview import (
    Preview,
    SearchedPhoto,
    preview_file,
    read_preview,
    write_preview,
)
from services.cli.locate.report import LocateOptions, print_changes, print_proposals, to_json
from services.cli.output import Json, print_json, progress_bar
from shared.errors import PlacewiseError
from shared.geotagging.evidence import (
    KnownPosition,
    PictureEvidence,
    PosePosition,
    ProbableCircle,
    SimilarPosition,
    TimeNeighbours,
    interpolate_position,
)
from shared.geotagging.fusion import propose_position
from shared.tracks.motion import MotionModel, parse_motion

SIMILAR_PHOTOS = 50
SEARCHES_AT_ONCE = 4
WITH_COORDINATES = "-90,-180,90,180"  # a box that contains all photos that have some


def locate_library(
    library: PhotoLibrary,
    options: LocateOptions,
    open_client: Callable[[], AbstractContextManager[Client]],
    **more_json: Json,
) -> bool:
    """Propose positions for the photos without coordinates, print, and with `write`, write them.

    With `write`, the searches are those that the last call without it has shown.

    Returns:
        Whether all photos could be searched and written.

    Raises:
        InvalidRequest: `unknown_time_zone`, `bad_gpx`, `bad_motion`.
    """
    moves = parse_motion(options.motion)
    photos = library.list_photos()
    path = preview_file(
        read_settings().placewise_home, library.identity, options.server, options.map_name
    )
    preview = read_preview(path) if options.picture and options.write else None
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
    located = [
        _locate_photo(photo, searches.get(photo.name), neighbours, track, moves, options.radius_m)
        for photo in unlocated
    ]
    accept_from = max(options.accept, 1e-9)
    accepted = [each for each in located if each.probability >= accept_from]
    written = None
    if options.write:
        # A place is written only if it is accepted, too.
        located_surely = [
            each if (each.place_probability or 0.0) >= accept_from else replace(each, place=None)
            for each in accepted
        ]
        written = library.write(located_surely)
    if options.as_json:
        print_json(to_json(photos, located, options.accept, written) | more_json)
    else:
        print_proposals(options, photos, located, accepted, written)
    if preview is not None:
        print_changes(preview, accepted)
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
        answer = client.similar(picture, top_k=SIMILAR_PHOTOS, pose=True, history=False)
        if answer.matches_without_place:  # they hide photos with coordinates
            located = client.similar(
                picture, top_k=SIMILAR_PHOTOS, box=WITH_COORDINATES, history=False
            )
            answer = answer.model_copy(update={"similar_images": located.similar_images})
    except PlacewiseError as error:
        if error.status not in (400, 413, 415, 422):  # 400: an empty file
            raise
        return SearchedPhoto(error=error.detail)
    estimate = answer.estimate
    named = () if estimate.in_map is False else estimate.levels
    label = next((each for each in named if each.place), None)
    return SearchedPhoto(
        picture_evidence(answer, photo_count),
        label.place if label else None,
        label.probability if label else None,
    )


def _locate_photo(
    photo: LibraryPhoto,
    searched: SearchedPhoto | None,
    neighbours: TimeNeighbours,
    track: Sequence[KnownPosition],
    moves: MotionModel,
    radius_m: float,
) -> LocatedPhoto:
    speed = moves.max_speed_mps
    on_track = None if photo.time is None else interpolate_position(track, photo.time, speed)
    searched = searched or SearchedPhoto()
    by_time = neighbours.position_of(photo, speed)
    return LocatedPhoto(
        photo,
        propose_position(searched.evidence, by_time, on_track, radius_m),
        searched.place,
        searched.place_probability,
        searched.error,
        neighbours.why_unknown(photo, searched.evidence),
    )


def picture_evidence(answer: Similar, photo_count: int) -> PictureEvidence:
    """Return what a search says about the position.

    Args:
        photo_count: Number of photos of the map.
    """
    estimate = answer.estimate
    is_unlocated = not (estimate.has_place or estimate.levels)
    stated = (estimate.not_in_map_probability, estimate.elsewhere)
    return PictureEvidence(
        [
            SimilarPosition(
                photo.latitude,
                photo.longitude,
                photo.similarity_score,
                photo.relative_path or photo.original_filename,
            )
            for photo in answer.similar_images
            if photo.latitude is not None and photo.longitude is not None and not is_unlocated
        ],
        [
            ProbableCircle(level.latitude, level.longitude, level.radius_m, level.probability)
            for level in estimate.levels
            if level.latitude is not None
            and level.longitude is not None
            and level.radius_m is not None
        ],
        next((share for share in stated if share is not None), 1.0),
        photo_count,
        _pose_position(answer.pose),
        estimate.headline,
    )


def _pose_position(pose: CameraPose | None) -> PosePosition | None:
    """Return the pose, if it has coordinates."""
    if pose is None or pose.latitude is None or pose.longitude is None:
        return None
    if pose.radius_68_m is None or pose.heading is None:
        return None
    return PosePosition(pose.latitude, pose.longitude, pose.radius_68_m, pose.heading)
