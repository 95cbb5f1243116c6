"""Which photos are taken: where, when, with which camera, and what each is for.

The city has three quarters of one style, far from each other: the map, whose photos are the
database and most queries; the outskirts, where the queries come from that no photo of the database
answers; and the school, whose photos a trainer learns from, so that nothing it sees is asked later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from shared.datasets.utm_filenames import UtmFileName
from shared.synthetic_city.camera import Camera
from shared.synthetic_city.sessions import (
    DATABASE_SESSIONS,
    QUERY_SESSIONS,
    SESSIONS,
    CaptureSession,
)
from shared.synthetic_city.streets import Quarter, ViewPoint, make_quarter
from shared.synthetic_city.textures import random_stream

ZONE_NUMBER, ZONE_LETTER = 32, "T"
ORIGIN_M = (480_000.0, 4_880_000.0)
"""open sea south of Genoa: nobody mistakes it for a real city"""
QUARTER_DISTANCE_M = 400.0
"""between two quarters: more than the 200 m that "out of map" promises"""
LANE_M = 1.6
"""by which a camera drives to the right of the street's middle; it looks to the left"""
DATABASE_FOV = 72.0
QUERY_FOV = (58.0, 86.0)
STEP_M = 3.0
"""a place's views are taken from up to this far before and behind it"""
QUERY_ALONG_M = 7.0
QUERY_ACROSS_M = 1.5
QUERY_YAW = 20.0
OTHER_WAY_SHARE = 0.08
"""of the queries on the map"""
SECONDS_PER_PHOTO = 4


@dataclass(frozen=True, slots=True)
class CityOptions:
    """Every argument that decides a pixel."""

    places: int
    views: int
    queries: int
    seed: int
    catalogue_seed: int
    out_of_map: float
    """share of the queries"""
    width: int
    height: int
    train: bool = True
    """whether a training set is drawn as well"""


@dataclass(frozen=True, slots=True)
class PlannedPhoto:
    """One photo to be taken."""

    role: str
    """`database`, `query` or `train`"""
    kind: str
    """`in_map`, `out_of_map` or `other_way`; always `in_map` for what is no query"""
    quarter: str
    place: int
    camera: Camera
    session: CaptureSession
    number: int
    """among the shots of its role"""
    folder: str
    """below the data set's root"""
    name: str


@dataclass(frozen=True, slots=True)
class CityPlan:
    options: CityOptions
    quarters: dict[str, Quarter]
    photos: list[PlannedPhoto]
    """neighbours in a street follow each other"""


def city_name(options: CityOptions) -> str:
    """The lowercase name by which gsv_xs knows the city."""
    return f"synth{options.catalogue_seed}x{options.seed}"


def make_plan(options: CityOptions) -> CityPlan:
    """All photos of the city with those options."""
    outside = round(options.queries * options.out_of_map)
    inside = options.queries - outside
    origin = ORIGIN_M
    quarters, places = {}, {}
    for name, wanted in (
        ("map", options.places),
        ("outskirts", max(1, min(outside, options.places))),
        ("school", options.places),
    ):
        quarter, found = make_quarter(options.seed, name, wanted, origin)
        quarters[name], places[name] = quarter, found
        origin = (quarter.far_east + QUARTER_DISTANCE_M, origin[1])
    shots = _database_shots(options, places["map"])
    rng = random_stream(options.seed, "queries")
    turned = round(inside * OTHER_WAY_SHARE)
    order = np.resize(rng.permutation(len(places["map"])), inside)
    for number in range(options.queries):
        if number < inside:
            kind = "other_way" if number < turned else "in_map"
            place, quarter_name = places["map"][int(order[number])], "map"
        else:
            kind, quarter_name = "out_of_map", "outskirts"
            place = places["outskirts"][(number - inside) % len(places["outskirts"])]
        shots.append(_query_shot(options, place, quarter_name, kind, number))
    if options.train:
        shots += _train_shots(options, places["school"])
    shots.sort(key=lambda shot: (shot.quarter, shot.place, shot.role, shot.number))
    return CityPlan(options, quarters, shots)


def _database_shots(options: CityOptions, places: list[ViewPoint]) -> list[PlannedPhoto]:
    """`views` shots of each place: sessions in turn, a step apart, a little turned."""
    shots = []
    steps = math.ceil(options.views / len(DATABASE_SESSIONS))
    for place in places:
        for view in range(options.views):
            rng = random_stream(options.seed, "database", place.number, view)
            session = DATABASE_SESSIONS[view % len(DATABASE_SESSIONS)]
            step = view // len(DATABASE_SESSIONS)
            share = 2 * step / (steps - 1) - 1 if steps > 1 else 0.0
            camera = _camera(
                options,
                place,
                along=share * STEP_M + rng.normal(0, 0.3),
                across=rng.normal(0, 0.25),
                yaw=-share * 6 + rng.normal(0, 2),
                fov=DATABASE_FOV,
                rng=rng,
            )
            number = place.number * options.views + view
            shots.append(
                _plan_photo(options, "database", "in_map", "map", place, camera, session, number)
            )
    return shots


def _query_shot(
    options: CityOptions, place: ViewPoint, quarter: str, kind: str, number: int
) -> PlannedPhoto:
    rng = random_stream(options.seed, "query", number)
    camera = _camera(
        options,
        place,
        along=rng.uniform(-QUERY_ALONG_M, QUERY_ALONG_M),
        across=rng.uniform(-QUERY_ACROSS_M, QUERY_ACROSS_M),
        yaw=rng.uniform(-QUERY_YAW, QUERY_YAW) + (180 if kind == "other_way" else 0),
        fov=rng.uniform(*QUERY_FOV),
        rng=rng,
    )
    session = QUERY_SESSIONS[int(rng.integers(len(QUERY_SESSIONS)))]
    return _plan_photo(options, "query", kind, quarter, place, camera, session, number)


def _train_shots(options: CityOptions, places: list[ViewPoint]) -> list[PlannedPhoto]:
    """At least four shots of each place of the school, each in another session."""
    shots = []
    views = min(max(4, options.views), len(SESSIONS))
    for place in places:
        order = random_stream(options.seed, "train", place.number).permutation(len(SESSIONS))
        for view in range(views):
            rng = random_stream(options.seed, "train", place.number, view)
            camera = _camera(
                options,
                place,
                along=rng.uniform(-QUERY_ALONG_M, QUERY_ALONG_M) * 0.7,
                across=rng.uniform(-QUERY_ACROSS_M, QUERY_ACROSS_M),
                yaw=rng.uniform(-QUERY_YAW, QUERY_YAW) * 0.7,
                fov=rng.uniform(*QUERY_FOV),
                rng=rng,
            )
            number = place.number * views + view
            session = SESSIONS[int(order[view])]
            shots.append(
                _plan_photo(options, "train", "in_map", "school", place, camera, session, number)
            )
    return shots


def _camera(
    options: CityOptions,
    place: ViewPoint,
    *,
    along: float,
    across: float,
    yaw: float,
    fov: float,
    rng: np.random.Generator,
) -> Camera:
    """A camera that much farther along the street, across it, and turned from the place's view.

    Its position is rounded to the centimetre that file names hold, so that both are one.
    """
    street = place.street
    spot = street.start + street.direction * (place.along + along)
    spot = spot + street.left * (across - LANE_M)
    return Camera(
        x=round(float(spot[0]), 2),
        y=round(float(spot[1]), 2),
        yaw=round((place.yaw + yaw) % 360, 2),
        fov=fov,
        eye=rng.uniform(1.55, 2.3),
        width=options.width,
        height=options.height,
        horizon=float(np.clip(rng.normal(0.62, 0.025), 0.55, 0.70)),
        roll=rng.normal(0, 0.8),
    )


def _plan_photo(
    options: CityOptions,
    role: str,
    kind: str,
    quarter: str,
    place: ViewPoint,
    camera: Camera,
    session: CaptureSession,
    number: int,
) -> PlannedPhoto:
    city = city_name(options)
    folder = {"database": "database", "query": "queries"}.get(role, f"gsv_xs/train/{city}")
    # gsv_xs reads the place from the note; elsewhere the note is the session's name.
    note = f"{place.number:05d}_{city}" if role == "train" else session.name
    name = UtmFileName(
        east=camera.x,
        north=camera.y,
        zone_number=ZONE_NUMBER,
        zone_letter=ZONE_LETTER,
        pano_id=f"{quarter}{place.number:05d}-{session.name}-{number:06d}",
        heading=camera.yaw,
        captured_at=_capture_time(session, number),
        note=note,
    ).file_name()
    return PlannedPhoto(role, kind, quarter, place.number, camera, session, number, folder, name)


def _capture_time(session: CaptureSession, number: int) -> datetime:
    """A drive takes hours: its photos follow each other within the session's day."""
    return session.starts_at + timedelta(seconds=SECONDS_PER_PHOTO * (number % 2000))
