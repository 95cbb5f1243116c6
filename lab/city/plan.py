"""City plan: which photos are taken, where, when, with which camera, and for which purpose.

The city has three quarters of one style, far from each other: `map`, with the database photos and
most queries; `outskirts`, with queries that no database photo matches; and `school`, with the
training photos, so that no place of the evaluation is in the training set.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import numpy as np

from lab.city.camera import Camera
from lab.city.rides import plan_ride
from lab.city.sessions import (
    DATABASE_SESSIONS,
    QUERY_SESSIONS,
    RIDE_SESSIONS,
    SESSIONS,
    CaptureSession,
)
from lab.city.streets import Quarter, ViewPoint, make_quarter
from lab.city.textures import random_stream
from lab.datasets.utm_names import UtmFileName

ZONE_NUMBER, ZONE_LETTER = 32, "T"
ORIGIN_M = (480_000.0, 4_880_000.0)
"""In the sea south of Genoa, so that it can't be confused with a real city"""
QUARTER_DISTANCE_M = 400.0
"""Between two quarters; `out_of_map` queries are at least 200 m from the database"""
LANE_M = 1.6
"""Offset of the camera to the right of the street's centre; it looks to the left"""
DATABASE_FOV = 72.0
QUERY_FOV = (58.0, 86.0)
STEP_M = 3.0
"""Maximum distance of a database view from its place along the street"""
QUERY_ALONG_M = 7.0
QUERY_ACROSS_M = 1.5
QUERY_YAW = 20.0
OTHER_WAY_SHARE = 0.08
"""Fraction of the in-map queries that look the other way"""
SECONDS_PER_PHOTO = 4


@dataclass(frozen=True, slots=True)
class CityOptions:
    """All arguments that determine the generated dataset."""

    places: int
    views: int
    queries: int
    seed: int
    catalogue_seed: int
    out_of_map: float
    """Fraction of the queries"""
    width: int
    height: int
    train: bool = True
    """Whether to generate a training set, too"""
    ride_frames: int = 0
    """Frames of each ride; 0 for no rides"""


@dataclass(frozen=True, slots=True)
class PlannedPhoto:
    """One photo to be rendered."""

    role: str
    """`database`, `query`, `ride` or `train`"""
    kind: str
    """`in_map`, `out_of_map` or `other_way`; always `in_map` for database and training photos"""
    quarter: str
    place: int
    camera: Camera
    session: CaptureSession
    number: int
    """Number among the photos of its role"""
    folder: str
    """Relative to the dataset's root"""
    name: str

    def path(self, root: Path) -> Path:
        return root / self.folder / self.name


@dataclass(frozen=True, slots=True)
class CityPlan:
    """The quarters and photos of a city."""

    options: CityOptions
    quarters: dict[str, Quarter]
    photos: list[PlannedPhoto]
    """Sorted so that neighbours in a street follow each other"""


def city_name(options: CityOptions) -> str:
    """Return the lowercase name of the city, as used in gsv_xs."""
    return f"synth{options.catalogue_seed}x{options.seed}"


def make_plan(options: CityOptions) -> CityPlan:
    """Plan all photos of a city."""
    outside = round(options.queries * options.out_of_map)
    inside = options.queries - outside
    origin = ORIGIN_M
    quarters, places = {}, {}
    for name, place_count in (
        ("map", options.places),
        ("outskirts", max(1, min(max(outside, options.ride_frames), options.places))),
        ("school", options.places),
    ):
        quarter, view_points = make_quarter(options.seed, name, place_count, origin)
        quarters[name], places[name] = quarter, view_points
        origin = (quarter.far_east + QUARTER_DISTANCE_M, origin[1])
    photos = [*_database_photos(options, places["map"])]
    rng = random_stream(options.seed, "queries")
    other_way = round(inside * OTHER_WAY_SHARE)
    order = np.resize(rng.permutation(len(places["map"])), inside)
    for number in range(options.queries):
        if number < inside:
            kind = "other_way" if number < other_way else "in_map"
            place = places["map"][int(order[number])]
        else:
            kind = "out_of_map"
            place = places["outskirts"][(number - inside) % len(places["outskirts"])]
        photos.append(_query_photo(options, place, kind, number))
    if options.ride_frames:
        photos += _ride_photos(options, places["map"], places["outskirts"])
    if options.train:
        photos += _train_photos(options, places["school"])
    photos.sort(key=lambda photo: (photo.quarter, photo.place, photo.role, photo.number))
    return CityPlan(options, quarters, photos)


def _database_photos(options: CityOptions, places: list[ViewPoint]) -> Iterator[PlannedPhoto]:
    """Plan `views` photos of each place, in alternating sessions, shifted and rotated slightly."""
    steps = math.ceil(options.views / len(DATABASE_SESSIONS))
    for place in places:
        for view in range(options.views):
            rng = random_stream(options.seed, "database", place.number, view)
            session = DATABASE_SESSIONS[view % len(DATABASE_SESSIONS)]
            step = view // len(DATABASE_SESSIONS)
            share = 2 * step / (steps - 1) - 1 if steps > 1 else 0.0
            along, across = share * STEP_M + rng.normal(0, 0.3), rng.normal(0, 0.25)
            yaw = -share * 6 + rng.normal(0, 2)
            camera = _camera(options, place, along, across, yaw, DATABASE_FOV, rng)
            number = place.number * options.views + view
            yield _plan_photo(options, "database", "in_map", place, camera, session, number)


def _query_photo(options: CityOptions, place: ViewPoint, kind: str, number: int) -> PlannedPhoto:
    rng = random_stream(options.seed, "query", number)
    along, across = (rng.uniform(-most, most) for most in (QUERY_ALONG_M, QUERY_ACROSS_M))
    yaw = rng.uniform(-QUERY_YAW, QUERY_YAW) + (180 if kind == "other_way" else 0)
    camera = _camera(options, place, along, across, yaw, rng.uniform(*QUERY_FOV), rng)
    session = QUERY_SESSIONS[int(rng.integers(len(QUERY_SESSIONS)))]
    return _plan_photo(options, "query", kind, place, camera, session, number)


def _ride_photos(
    options: CityOptions, places: list[ViewPoint], outskirts: list[ViewPoint]
) -> Iterator[PlannedPhoto]:
    """Plan the same ride in each of RIDE_SESSIONS, with another camera each time."""
    frames = plan_ride(random_stream(options.seed, "ride"), places, outskirts, options.ride_frames)
    for session in RIDE_SESSIONS:
        fov = random_stream(options.seed, "ride", session.name).uniform(*QUERY_FOV)
        for number, frame in enumerate(frames):
            rng = random_stream(options.seed, "ride", session.name, number)
            across, yaw = rng.normal(0, 0.1), rng.normal(0, 1.5)
            camera = _camera(options, frame.place, frame.along, across, yaw, fov, rng)
            kind = "in_map" if frame.is_in_map else "out_of_map"
            yield _plan_photo(options, "ride", kind, frame.place, camera, session, number)


def _train_photos(options: CityOptions, places: list[ViewPoint]) -> Iterator[PlannedPhoto]:
    """Plan at least four photos of each training place, each in a different session."""
    views = min(max(4, options.views), len(SESSIONS))
    for place in places:
        order = random_stream(options.seed, "train", place.number).permutation(len(SESSIONS))
        for view in range(views):
            rng = random_stream(options.seed, "train", place.number, view)
            along, across = (rng.uniform(-most, most) for most in (QUERY_ALONG_M, QUERY_ACROSS_M))
            yaw = rng.uniform(-QUERY_YAW, QUERY_YAW) * 0.7
            fov = rng.uniform(*QUERY_FOV)
            camera = _camera(options, place, along * 0.7, across, yaw, fov, rng)
            number, session = place.number * views + view, SESSIONS[int(order[view])]
            yield _plan_photo(options, "train", "in_map", place, camera, session, number)


def _camera(
    options: CityOptions,
    place: ViewPoint,
    along: float,
    across: float,
    yaw: float,
    fov: float,
    rng: np.random.Generator,
) -> Camera:
    """Create a camera near a place's view point, at whole centimetres, as file names have them."""
    street = place.street
    position = street.start + street.direction * (place.along + along)
    position = position + street.left * (across - LANE_M)
    eye = rng.uniform(1.55, 2.3)
    above = float(np.clip(rng.normal(0.12, 0.025), 0.05, 0.20)) * options.height
    focal = options.width / 2 / math.tan(math.radians(fov) / 2)
    return Camera(
        x=round(float(position[0]), 2),
        y=round(float(position[1]), 2),
        yaw=round((place.yaw + yaw) % 360, 2),
        fov=fov,
        eye=eye,
        width=options.width,
        height=options.height,
        pitch=math.degrees(math.atan(above / focal)),
        roll=rng.normal(0, 0.8),
    )


def _plan_photo(
    options: CityOptions,
    role: str,
    kind: str,
    place: ViewPoint,
    camera: Camera,
    session: CaptureSession,
    number: int,
) -> PlannedPhoto:
    city = city_name(options)
    quarter = "school" if role == "train" else "outskirts" if kind == "out_of_map" else "map"
    folders = {"database": "database", "query": "queries", "ride": f"rides/{session.name}"}
    folder = folders.get(role, f"gsv_xs/train/{city}")
    # gsv_xs stores the place in the note; other photos store the session's name there.
    note = f"{place.number:05d}_{city}" if role == "train" else session.name
    # The photos of a session follow each other within its day, those of a ride every second.
    seconds = number if role == "ride" else SECONDS_PER_PHOTO * (number % 2000)
    name = UtmFileName(
        east=camera.x,
        north=camera.y,
        zone_number=ZONE_NUMBER,
        zone_letter=ZONE_LETTER,
        pano_id=f"{quarter}{place.number:05d}-{session.name}-{number:06d}",
        heading=camera.yaw,
        captured_at=session.starts_at + timedelta(seconds=seconds),
        note=note,
    ).file_name()
    return PlannedPhoto(role, kind, quarter, place.number, camera, session, number, folder, name)
