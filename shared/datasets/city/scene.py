"""What stands in the streets of a quarter: trees, lamps, posts and bins for ever, vehicles for a
day."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.datasets.city.catalogue import VEHICLE_PAINTS, Catalogue
from shared.datasets.city.random_streams import random_stream
from shared.datasets.city.street_things import Sprite
from shared.datasets.city.streets import PAVEMENT_M, Metres, Quarter, Street
from shared.datasets.city.vehicles import VEHICLE_SHARES

KERB_CLEARANCE_M = 1.05
"""from the kerb to the middle of a parked vehicle"""
CORNER_M = 9.0
"""kept free of parked vehicles at both ends of a street"""
BLADE_REACH_M = 0.85


@dataclass(frozen=True, slots=True)
class StreetObject:
    """Something that is seen from every side as the same flat picture."""

    position: Metres
    kind: str
    """`tree`, or the picture's tuple in the catalogue: lamps, posts, boxes"""
    index: int


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A box: its sides and its ends are flat pictures."""

    position: Metres
    """of its middle"""
    heading: Metres
    """unit vector towards its nose"""
    index: int


@dataclass(frozen=True, slots=True)
class VehiclePanel:
    """A vertical picture in the city that runs left to right as it is seen."""

    start: Metres
    direction: Metres
    picture: Sprite
    key: tuple[str, int]
    mirrored: bool = False


def place_street_objects(
    quarter: Quarter, street: Street, catalogue: Catalogue
) -> list[StreetObject]:
    """What stands on the street's pavements on every day."""
    rng = random_stream(quarter.seed, quarter.name, "standing", street.number)
    things = []
    kerb = street.half_width - PAVEMENT_M
    for side in (-1.0, 1.0):

        def on_pavement(along: float, out: float, side: float = side) -> Metres:
            middle = street.start + street.direction * along
            return np.asarray(middle + street.left * side * (kerb + out))

        if street.trees:
            along = 14.0 + rng.uniform(0, street.trees)
            while along < street.length - 14.0:
                index = int(rng.integers(len(catalogue.trees["summer"])))
                if rng.uniform() < 0.85:
                    things.append(StreetObject(on_pavement(along, 0.7), "tree", index))
                along += street.trees * rng.uniform(0.8, 1.25)
        along = 10.0 + rng.uniform(0, 22)
        while along < street.length - 8.0:
            things.append(StreetObject(on_pavement(along, 0.35), "lamps", 0))
            along += rng.uniform(22, 30)
        for kind, count in (("posts", rng.poisson(1.6)), ("boxes", rng.poisson(1.4))):
            for _ in range(int(count)):
                along = rng.uniform(10, max(11.0, street.length - 10))
                index = int(rng.integers(len(getattr(catalogue, kind))))
                things.append(StreetObject(on_pavement(along, rng.uniform(0.3, 0.6)), kind, index))
    return things


def place_vehicles(quarter: Quarter, street: Street, day: str) -> list[Vehicle]:
    """The vehicles of one day: parked at both kerbs, and a few on the move."""
    rng = random_stream(quarter.seed, quarter.name, "vehicles", street.number, day)
    vehicles = []
    lane = street.half_width - PAVEMENT_M - KERB_CLEARANCE_M
    for side in (-1.0, 1.0):
        along = CORNER_M + rng.uniform(0, 6) + street.half_width
        while along < street.length - CORNER_M - street.half_width:
            if rng.uniform() < street.parking:
                index = _any_vehicle(rng)
                middle = street.start + street.direction * along
                vehicles.append(
                    Vehicle(middle + street.left * side * lane, street.direction * -side, index)
                )
            along += 6.2 + rng.uniform(0, 1.5)
    for _ in range(int(rng.poisson(0.7))):
        side = float(rng.choice([-1.0, 1.0]))
        middle = street.start + street.direction * rng.uniform(10, street.length - 10)
        vehicles.append(
            Vehicle(
                middle + street.left * side * lane * 0.4,
                street.direction * -side,
                _any_vehicle(rng),
            )
        )
    return vehicles


def _any_vehicle(rng: np.random.Generator) -> int:
    """Its index in the catalogue, where all paints of one shape follow each other."""
    shape = int(rng.choice(len(VEHICLE_SHARES), p=VEHICLE_SHARES))
    return shape * len(VEHICLE_PAINTS) + int(rng.integers(len(VEHICLE_PAINTS)))


def vehicle_panels(vehicle: Vehicle, catalogue: Catalogue, seen_from: Metres) -> list[VehiclePanel]:
    """The side and the end of the vehicle that are seen from a point."""
    side = catalogue.vehicle_sides[vehicle.index]
    front = catalogue.vehicle_fronts[vehicle.index]
    ahead = vehicle.heading
    left = np.array([-ahead[1], ahead[0]])
    away = seen_from - vehicle.position
    half_length, half_width = side.width / 2, front.width / 2
    panels = []
    if away @ left > half_width:  # from its left its nose is on the left
        start = vehicle.position + left * half_width + ahead * half_length
        panels.append(VehiclePanel(start, -ahead, side, ("side", vehicle.index)))
    elif away @ left < -half_width:
        start = vehicle.position - left * half_width - ahead * half_length
        panels.append(VehiclePanel(start, ahead, side, ("side", vehicle.index), mirrored=True))
    screen = catalogue.vehicle_screens[vehicle.index]
    to_front, to_back = (half_length - metres for metres in catalogue.cabins[vehicle.index])
    if away @ ahead > half_length:
        start = vehicle.position + ahead * half_length - left * half_width
        panels.append(VehiclePanel(start, left, front, ("front", vehicle.index)))
        start = vehicle.position + ahead * to_front - left * half_width
        panels.append(VehiclePanel(start, left, screen, ("screen", vehicle.index)))
    elif away @ ahead < -half_length:
        start = vehicle.position - ahead * half_length + left * half_width
        rear = catalogue.vehicle_rears[vehicle.index]
        panels.append(VehiclePanel(start, -left, rear, ("rear", vehicle.index)))
        start = vehicle.position + ahead * to_back + left * half_width
        panels.append(VehiclePanel(start, -left, screen, ("screen", vehicle.index)))
    return panels


def shop_blades(
    quarter: Quarter, side: int, catalogue: Catalogue
) -> list[tuple[Metres, Metres, int]]:
    """Boards that stand out from the shops of a facade row: foot, outward direction, index."""
    row = quarter.sides[side]
    outwards = np.array([row.direction[1], -row.direction[0]])
    blades = []
    for plot in range(len(row.cuts) - 1):
        house = quarter.house(side, plot)
        for bay, shop in enumerate(house.shops):
            if shop >= 0 and shop % 3 == 0 and bay != house.door_bay:
                along = row.cuts[plot] + (bay + 0.04) * house.width / house.bays
                foot = row.start + row.direction * along
                blades.append((foot, outwards, shop % len(catalogue.blades)))
    return blades
