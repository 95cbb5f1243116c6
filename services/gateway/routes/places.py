"""Routes that propose places for photos of a map that have none, give them, and undo that.

A place is given only where a photo has none. What was there before is kept in the photo's row
(`Photo.given_place`), so that it can be undone until the photo is deleted.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import MAXYEAR, UTC, datetime, timedelta
from functools import partial
from typing import Annotated, Any, Self
from uuid import UUID

from fastapi import APIRouter, Query
from pydantic import Field, model_validator
from sqlalchemy import Row, func, or_, select, true
from sqlalchemy.orm import Session

from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import (
    NO_NUL_PATTERN,
    GatewayContext,
    GatewayDep,
    MapPageParams,
    MapQuery,
)
from services.gateway.responses import photo_response
from services.gateway.routes.positions import (
    FiniteModel,
    Latitude,
    Longitude,
    Probability,
    ProposalOptions,
    proposal_fields,
)
from services.gateway.similarity.execute import find_similar, query_from_photo
from services.gateway.similarity.search_params import SearchParams
from shared.catalog.chunks import count_searchable
from shared.catalog.database.base import Condition, count_rows, for_update
from shared.catalog.generations import active_generation
from shared.catalog.maps import get_map, increment_map_version, lock_map
from shared.catalog.photos import Photo, has_given_place, is_geotagged
from shared.enums import PhotoRole
from shared.errors import Conflict
from shared.geodesy import distance_m
from shared.geotagging.evidence import DatedPhoto, add_time_zones
from shared.geotagging.fusion import Proposal
from shared.geotagging.locate import (
    SIMILAR_PHOTOS,
    PositionFinder,
    picture_evidence,
    probable_label,
    search_for_position,
)
from shared.http.request_model import FailFastList, RequestModel
from shared.imaging.capture_place import is_null_island
from shared.ingest.photo_metadata import MAX_TEXT_CHARACTERS
from shared.responses.reconstructions import (
    GivenPlacesResponse,
    PlaceProposalsResponse,
    StoredProposalResponse,
    UndonePlacesResponse,
)
from shared.responses.similarity import (
    DeniedPlace,
    PhotoResponse,
    SimilarityResponse,
    SimilarPhotoResponse,
)
from shared.search_api.photo_filter import Box, PhotoFilter

router = APIRouter(tags=["photos"])

PROPOSALS_PATH = "/places/proposals"
MAX_GIVEN = 1000
WITH_COORDINATES = PhotoFilter(box=Box(south=-90, west=-180, north=90, east=180))
CLOCK_HOURS = 15
"""Between two clocks that show different zones, and the photos that a proposal may rest on"""
MAX_NEIGHBOURS = 10_000

Label = Annotated[str, Field(max_length=MAX_TEXT_CHARACTERS, pattern=NO_NUL_PATTERN)]


class GivenPlaceBody(FiniteModel):
    """A place for one photo, or one where it was not taken."""

    file_id: UUID
    latitude: Latitude | None = None
    longitude: Longitude | None = None
    heading: float | None = Field(None, ge=0, le=360, description="kept only if it has none")
    place: Label | None = Field(None, description="label, in a map of labels")
    probability: Probability | None = Field(
        None, description="of the proposal; omit it for a place that a person chose"
    )
    reason: str = Field("", max_length=MAX_TEXT_CHARACTERS, pattern=NO_NUL_PATTERN)
    denied: bool = Field(
        False, description="the photo was not taken there: it gets no place, and evaluations know"
    )
    radius_m: float | None = Field(None, gt=0, description="of the circle that is denied")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.latitude is None) != (self.longitude is None):
            raise ValueError("send both `latitude` and `longitude`, or neither")
        self.place = (self.place or "").strip() or None
        if self.latitude is None and self.place is None:
            raise ValueError("send coordinates or a `place`")
        if self.latitude is not None and is_null_island(self.latitude, self.longitude or 0.0):
            raise ValueError("0, 0 are the coordinates of no place")
        return self

    def columns(self, photo: Photo) -> dict[str, Any]:
        """Return the columns that the place sets."""
        columns: dict[str, Any] = {}
        if self.denied:
            return columns
        if self.latitude is not None:
            columns |= {"latitude": self.latitude, "longitude": self.longitude}
        if self.heading is not None and photo.heading is None:
            columns["heading"] = self.heading % 360
        if self.place:
            columns["place"] = self.place
        return columns


class ProposalsParams(MapPageParams):
    limit: int = Field(20, ge=1, le=50, description="each photo of a page is searched with")


class GivenPlacesBody(RequestModel):
    photos: FailFastList[GivenPlaceBody] = Field(min_length=1, max_length=MAX_GIVEN)


class UndoPlacesBody(RequestModel):
    file_ids: list[UUID] | None = Field(
        None, max_length=MAX_GIVEN, description="omitted: all photos whose place was given"
    )


@router.post(PROPOSALS_PATH, dependencies=[READ])
def propose_places(
    gateway: GatewayDep, query: Annotated[ProposalsParams, Query()], options: ProposalOptions
) -> PlaceProposalsResponse:
    """Propose places for the photos of a map that have neither coordinates nor a label.

    Each proposal combines what a search with the photo finds, photos of the same camera that were
    taken shortly before or after, and a GPX track. Test photos are left out. Nothing is stored.
    """
    with gateway.catalog.read() as session:
        without = (
            Photo.map_id == get_map(session, query.map).id,
            Photo.deleted_at.is_(None),
            Photo.role == PhotoRole.DATABASE,
            ~is_geotagged(),
        )
        total = count_rows(session, select(Photo.id).where(*without))
        page, next_cursor = query.read(session, Photo, *without)
    return PlaceProposalsResponse(
        total=total,
        proposals=_propose_places(gateway, query.map, page, options),
        next_cursor=next_cursor,
    )


@router.post("/places", dependencies=[WRITE])
def give_places(gateway: GatewayDep, query: MapQuery, body: GivenPlacesBody) -> GivenPlacesResponse:
    """Give places to photos that have none, such as accepted proposals.

    A photo that has coordinates or a label is skipped. What a photo had before is kept: `POST
    /places/undo` restores it.
    """
    return gateway.catalog.run(
        lambda session: _give_places(session, get_map(session, query.map).id, body.photos)
    )


@router.post("/places/undo", dependencies=[WRITE])
def undo_places(gateway: GatewayDep, query: MapQuery, body: UndoPlacesBody) -> UndonePlacesResponse:
    """Take back given places: photos have the values that they had before.

    A photo whose place was changed since is left as it is, and named.
    """
    return gateway.catalog.run(
        lambda session: _undo_places(session, get_map(session, query.map).id, body.file_ids)
    )


def _read_dated_photos(
    session: Session, map_id: UUID, photos: Sequence[Photo]
) -> dict[UUID, DatedPhoto]:
    """Return the photos, and those that were taken in the same hours, with comparable times.

    A place that was given by a proposal is none: it would count twice what that rested on.
    """
    hours = timedelta(hours=CLOCK_HOURS)
    ids = [photo.id for photo in photos]
    # Clocks that were never set show the year 1, from which nothing can be subtracted.
    times = [p.captured_at for p in photos if p.captured_at and 1 < p.captured_at.year < MAXYEAR]
    same_hours = [Photo.captured_at.between(time - hours, time + hours) for time in times]
    rows = session.execute(
        select(
            Photo.id,
            func.coalesce(Photo.relative_path, Photo.filename).label("name"),
            Photo.captured_at,
            Photo.capture,
            Photo.latitude,
            Photo.longitude,
            Photo.given_place,
        )
        .where(
            Photo.map_id == map_id,
            Photo.deleted_at.is_(None),
            or_(Photo.id.in_(ids), *same_hours),
        )
        .order_by(
            Photo.id.not_in(ids), Photo.given_place.is_not(None), Photo.latitude.is_(None), Photo.id
        )
        .limit(MAX_NEIGHBOURS)
    ).all()
    dated = add_time_zones([_dated_photo(row) for row in rows])
    return {row.id: photo for row, photo in zip(rows, dated, strict=True)}


def _dated_photo(row: Row[Any]) -> DatedPhoto:
    capture = row.capture or {}
    is_estimated = row.given_place and row.given_place["probability"] is not None
    offset = capture.get("clock_offset_seconds")
    return DatedPhoto(
        row.name,
        row.captured_at,
        capture.get("time_zone_is_known", False),
        capture.get("camera"),
        None if is_estimated else row.latitude,
        None if is_estimated else row.longitude,
        None if offset is None else timedelta(seconds=offset),
        capture.get("camera_is_unique", False),
    )


def _search_for_place(gateway: GatewayContext, map_name: str, photo: Photo) -> SimilarityResponse:
    """Search the map with a photo of it, as `locate` does with a file.

    Raises:
        Conflict: `not_searchable`.
    """
    query = query_from_photo(gateway, map_name, photo.id)
    search = partial(find_similar, gateway, query)
    return search_for_position(
        lambda: search(SearchParams(top_k=SIMILAR_PHOTOS, pose=True, history=False)),
        lambda: search(SearchParams(top_k=SIMILAR_PHOTOS, photos=WITH_COORDINATES, history=False)),
    )


def _is_at(
    photo: SimilarPhotoResponse | DeniedPlace, proposal: Proposal | None, label: str | None
) -> bool:
    """Return whether a photo has a place that a proposal, or else a label, speaks of."""
    if proposal is None:
        return label is not None and photo.place == label
    if photo.latitude is None or photo.longitude is None:
        return False
    to = (photo.latitude, photo.longitude)
    return distance_m(proposal.latitude, proposal.longitude, *to) <= proposal.radius_m


def _propose_places(
    gateway: GatewayContext,
    map_name: str,
    photos: Sequence[Photo],
    options: ProposalOptions,
) -> list[StoredProposalResponse]:
    """Propose places for photos of the map that have none. Nothing is stored."""
    with gateway.catalog.read() as session:
        map_id = get_map(session, map_name).id
        generation = active_generation(session, map_id)
        photo_count = count_searchable(session, generation.id) if generation else 0
        dated = _read_dated_photos(session, map_id, photos)
    finder = options.finder(list(dated.values()))
    return [
        _propose_place(gateway, map_name, photo, dated[photo.id], finder, photo_count)
        for photo in photos
    ]


def _propose_place(
    gateway: GatewayContext,
    map_name: str,
    photo: Photo,
    dated: DatedPhoto,
    finder: PositionFinder,
    photo_count: int,
) -> StoredProposalResponse:
    picture, error, label, probability = None, None, None, None
    similar: Sequence[SimilarPhotoResponse] = ()
    try:
        answer = _search_for_place(gateway, map_name, photo)
    except Conflict as problem:  # it is not described yet, or can't be
        error = problem.detail
    else:
        picture, similar = picture_evidence(answer, photo_count), answer.similar_images
        label, probability = probable_label(answer.estimate)
    proposal, reason = finder.propose(dated, picture)
    denied = (photo.given_place or {}).get("denied")
    if denied and _is_at(DeniedPlace(**denied), proposal, label):
        proposal, label, probability = None, None, None
        error = "A person said that it was not taken where it seems to be"
    if gps_error := (photo.capture or {}).get("gps_error"):
        proposal, label, probability = None, None, None
        error = f"It may have coordinates: {gps_error}"
    return StoredProposalResponse(
        **proposal_fields(dated.name, proposal, reason, finder.radius_m),
        photo=photo_response(PhotoResponse, photo, map_name),
        place=label,
        place_probability=probability,
        looks_like=next((each for each in similar if _is_at(each, proposal, label)), None),
        error=error,
    )


def _give_places(
    session: Session, map_id: UUID, places: Sequence[GivenPlaceBody]
) -> GivenPlacesResponse:
    """Give places to photos that have none, and keep what was there before."""
    lock_map(session, map_id)
    photos = _lock_photos(session, map_id, Photo.id.in_([place.file_id for place in places]))
    by_id = {photo.id: photo for photo in photos}
    skipped: dict[UUID, str] = {}
    version = increment_map_version(session, map_id)
    for place in places:
        photo = by_id.get(place.file_id)
        if photo is None:
            skipped[place.file_id] = "is not in this map any more"
        elif photo.latitude is not None or photo.place is not None:
            skipped[place.file_id] = "has a place meanwhile"
        else:
            written = place.columns(photo)
            photo.given_place = {
                "former": {name: getattr(photo, name) for name in written},
                "written": written,
                "probability": place.probability,
                "reason": place.reason,
                "given_at": datetime.now(UTC).isoformat(),
            }
            if place.denied:
                named = {"latitude", "longitude", "radius_m", "place"}
                photo.given_place["denied"] = place.model_dump(include=named)
            for name, value in written.items():
                setattr(photo, name, value)
            photo.changed_version = version
    given = [place.file_id for place in places if place.file_id not in skipped]
    return GivenPlacesResponse(given=given, skipped=skipped)


def _undo_places(
    session: Session, map_id: UUID, photo_ids: Sequence[UUID] | None
) -> UndonePlacesResponse:
    """Restore what photos had before their place was given; None: all photos of the map.

    What has changed since is left as it is, and is no given place any more.
    """
    lock_map(session, map_id)
    chosen = true() if photo_ids is None else Photo.id.in_(photo_ids)
    version = increment_map_version(session, map_id)
    restored, changed = [], []
    for photo in _lock_photos(session, map_id, chosen, has_given_place()):
        journal = photo.given_place or {}
        if photo.place_is_as_given:
            for name, value in journal["former"].items():
                setattr(photo, name, value)
            photo.changed_version = version
            restored.append(photo.id)
        else:
            changed.append(photo.id)
        photo.given_place = None
    return UndonePlacesResponse(restored=restored, changed_since=changed)


def _lock_photos(session: Session, map_id: UUID, *conditions: Condition) -> Sequence[Photo]:
    live = select(Photo).where(Photo.map_id == map_id, Photo.deleted_at.is_(None), *conditions)
    return session.scalars(for_update(live.order_by(Photo.id))).all()
