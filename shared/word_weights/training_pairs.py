"""Samples the training pairs of word weights: photos of the same place and of different places.

By coordinates, photos 5 to 25 m apart show the same place. Closer photos are often one burst, whose
similarity does not carry over to other days. Photos more than 50 m apart show different places. If
coordinates give too few pairs (rooms have none), equal and different place labels are used.

The map is split into two halves by place, and each pair is inside one half. Weights fitted on one
half can therefore be validated on photos of the other half, which were not used for training.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from shared.evaluation.places.evidence import PhotoLocation, distance_between_m
from shared.geodesy import EARTH_RADIUS_M, distances_m, latitude_bounds

NEAREST_M, NEAR_M, FAR_M = 5.0, 25.0, 50.0
CELL_M = 100.0  # side of the squares that are assigned to a half
MAX_PAIRS = 1000  # per kind and half; the standard error of a mean is then 3 % of the deviation
MIN_PAIRS = 50  # per kind and half; with fewer pairs a weight is unreliable
PARTNERS_PER_PHOTO = 4  # maximum; keeps a place with hundreds of photos from dominating
MAX_TRIES = 20  # random draws per requested far pair

Indices = NDArray[np.int64]


class PairSource(StrEnum):
    """What decides whether two photos show the same place."""

    COORDINATES = "coordinates"
    PLACES = "places"  # place labels


@dataclass(frozen=True, slots=True)
class PairBatch:
    """Photos whose descriptors are loaded together, and the pairs among them."""

    photos: list[int]
    """indices into the map's photos, unique"""
    near: Indices
    """(n, 2) same-place pairs, as indices into `photos`"""
    far: Indices
    """(m, 2) different-place pairs, as indices into `photos`"""


@dataclass(frozen=True, slots=True)
class PairSplit:
    """Training pairs of both halves of the map."""

    source: PairSource
    halves: list[int]
    """half (0 or 1) of each of the map's photos"""
    batches: tuple[list[PairBatch], list[PairBatch]]
    """batches of each half"""

    def counts(self) -> list[tuple[int, int]]:
        """Return the numbers of near and far pairs of each half."""
        return [
            (sum(len(batch.near) for batch in half), sum(len(batch.far) for batch in half))
            for half in self.batches
        ]

    @property
    def is_enough(self) -> bool:
        """Whether both halves have `MIN_PAIRS` of each kind."""
        return min(min(counts) for counts in self.counts()) >= MIN_PAIRS


def sample_pairs(locations: Sequence[PhotoLocation], seed: int, batch_photos: int) -> PairSplit:
    """Sample up to `MAX_PAIRS` pairs of each kind in each half of the map.

    Uses coordinates if they give enough pairs, else labels. If neither gives enough, the source
    with more near pairs is returned. The result is deterministic for equal locations and seed.
    """
    candidates = []
    for source in PairSource:
        split = _sample_from(locations, source, np.random.default_rng(seed), batch_photos)
        if split.is_enough:
            return split
        candidates.append(split)
    return max(candidates, key=lambda split: sum(near for near, _ in split.counts()))


def _sample_from(
    locations: Sequence[PhotoLocation],
    source: PairSource,
    rng: np.random.Generator,
    batch_photos: int,
) -> PairSplit:
    halves = _assign_halves([_cell(location, source) for location in locations], rng)
    is_known: Callable[[PhotoLocation], bool] = (
        (lambda location: location.latitude is not None)
        if source == PairSource.COORDINATES
        else (lambda location: location.place is not None)
    )
    batches: list[list[PairBatch]] = []
    for half in (0, 1):
        members = [
            i for i, location in enumerate(locations) if halves[i] == half and is_known(location)
        ]
        near = (_near_by_distance if source == PairSource.COORDINATES else _near_by_label)(
            locations, members, rng
        )
        batches.append(_make_batches(locations, near, source, rng, batch_photos))
    return PairSplit(source, halves, (batches[0], batches[1]))


def _cell(location: PhotoLocation, source: PairSource) -> Hashable:
    """Return the key of the photos that must be in the same half."""
    if location.latitude is None or location.longitude is None:
        return location.place
    if source == PairSource.PLACES and location.place is not None:
        return location.place
    cell_degrees = math.degrees(CELL_M / EARTH_RADIUS_M)
    row = math.floor(location.latitude / cell_degrees)
    scale = max(math.cos(math.radians(row * cell_degrees)), 1e-6)
    return row, math.floor(location.longitude * scale / cell_degrees)


def _assign_halves(cells: Sequence[Hashable], rng: np.random.Generator) -> list[int]:
    """Assign cells in random order, each to the half with fewer photos so far."""
    sizes: dict[Hashable, int] = {}
    for cell in cells:
        sizes[cell] = sizes.get(cell, 0) + 1
    half_by_cell: dict[Hashable, int] = {}
    photo_counts = [0, 0]
    order = list(sizes)
    for index in rng.permutation(len(order)).tolist():
        half = int(photo_counts[1] < photo_counts[0])
        half_by_cell[order[index]] = half
        photo_counts[half] += sizes[order[index]]
    return [half_by_cell[cell] for cell in cells]


def _near_by_distance(
    locations: Sequence[PhotoLocation], members: Sequence[int], rng: np.random.Generator
) -> list[tuple[int, int]]:
    degrees = np.array(
        [(locations[i].latitude, locations[i].longitude) for i in members], dtype=np.float64
    ).reshape(-1, 2)
    order = np.argsort(degrees[:, 0], kind="stable")
    degrees = degrees[order]

    def partners(anchor: int) -> Indices:
        latitude, longitude = degrees[anchor].tolist()
        first, last = np.searchsorted(degrees[:, 0], latitude_bounds(latitude, NEAR_M))
        metres = distances_m(latitude, longitude, degrees[first:last, 0], degrees[first:last, 1])
        indices: Indices = first + np.flatnonzero((metres >= NEAREST_M) & (metres <= NEAR_M))
        return indices

    return [
        (members[int(order[a])], members[int(order[b])])
        for a, b in _sample_near_pairs(len(members), partners, rng)
    ]


def _near_by_label(
    locations: Sequence[PhotoLocation], members: Sequence[int], rng: np.random.Generator
) -> list[tuple[int, int]]:
    positions: dict[str | None, list[int]] = {}
    for position, i in enumerate(members):
        positions.setdefault(locations[i].place, []).append(position)
    by_label = {label: np.array(same) for label, same in positions.items()}

    def partners(anchor: int) -> Indices:
        same = by_label[locations[members[anchor]].place]
        others: Indices = same[same != anchor]
        return others

    return [(members[a], members[b]) for a, b in _sample_near_pairs(len(members), partners, rng)]


def _sample_near_pairs(
    count: int, partners: Callable[[int], Indices], rng: np.random.Generator
) -> list[tuple[int, int]]:
    """Sample up to `MAX_PAIRS` distinct pairs: anchors in random order, random partners."""
    pairs: dict[tuple[int, int], None] = {}
    for anchor in rng.permutation(count).tolist():
        candidates = partners(anchor)
        sampled = rng.choice(
            candidates, size=min(PARTNERS_PER_PHOTO, len(candidates)), replace=False
        )
        for partner in sampled.tolist():
            pairs[min(anchor, partner), max(anchor, partner)] = None
        if len(pairs) >= MAX_PAIRS:
            break
    return list(pairs)[:MAX_PAIRS]


def _make_batches(
    locations: Sequence[PhotoLocation],
    near: Sequence[tuple[int, int]],
    source: PairSource,
    rng: np.random.Generator,
    batch_photos: int,
) -> list[PairBatch]:
    """Split the near pairs, in random order, into batches of up to `batch_photos` photos.

    Each batch gets as many far pairs of the same photos, so that these need no further photos.
    """
    batches: list[PairBatch] = []
    positions: dict[int, int] = {}
    pairs: list[tuple[int, int]] = []

    def close_batch() -> None:
        if pairs:
            photos = list(positions)
            far = _sample_far_pairs([locations[i] for i in photos], len(pairs), source, rng)
            batches.append(PairBatch(photos, np.array(pairs, dtype=np.int64), far))

    for index in rng.permutation(len(near)).tolist():
        new = [i for i in near[index] if i not in positions]
        if len(positions) + len(new) > batch_photos:
            close_batch()
            positions, pairs = {}, []
        a, b = (positions.setdefault(i, len(positions)) for i in near[index])
        pairs.append((a, b))
    close_batch()
    return batches


def _sample_far_pairs(
    locations: Sequence[PhotoLocation], count: int, source: PairSource, rng: np.random.Generator
) -> Indices:
    """Sample up to `count` distinct different-place pairs, as (m, 2) indices."""
    pairs: dict[tuple[int, int], None] = {}
    for a, b in rng.integers(len(locations), size=(MAX_TRIES * count, 2)).tolist():
        if a != b and _are_far(locations[a], locations[b], source):
            pairs[min(a, b), max(a, b)] = None
        if len(pairs) == count:
            break
    return np.array(list(pairs), dtype=np.int64).reshape(-1, 2)


def _are_far(a: PhotoLocation, b: PhotoLocation, source: PairSource) -> bool:
    if source == PairSource.PLACES:
        return a.place != b.place
    distance = distance_between_m(a, b)
    return distance is not None and distance > FAR_M
