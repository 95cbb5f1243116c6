"""Which photos of a map teach: pairs of one place, and of two.

By coordinates one place means 5 to 25 m apart: nearer photos are often one burst, alike for reasons
that no other day repeats. Farther than 50 m is another place. Where coordinates give too few pairs
(rooms) labels decide: the same one, or another.

The map is dealt out in two halves, place by place, and every pair lies inside one of them. So what
one half has taught can be tried on photos of the other, which it has never seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from shared.evaluation.place_evidence import PhotoLocation, distance_between_m
from shared.geodesy import EARTH_RADIUS_M, distances_m, latitude_bounds

NEAREST_M, NEAR_M, FAR_M = 5.0, 25.0, 50.0
CELL_M = 100.0  # side of what is dealt to one half or the other
MAX_PAIRS = 1000  # of a kind in a half: a mean is then known to 3 % of the deviation
MIN_PAIRS = 50  # of a kind in a half: with fewer a weight is a guess
PARTNERS_PER_PHOTO = (
    4  # of one photo at most: a place with hundreds of photos is not the whole lesson
)
MAX_TRIES = 20  # draws for each far pair that is wanted

Indices = NDArray[np.int64]


class PairSource(StrEnum):
    COORDINATES = "coordinates"
    PLACES = "places"  # labels


@dataclass(frozen=True, slots=True)
class PairBatch:
    """Photos that are looked at together, and the pairs among them."""

    photos: list[int]
    """Indices into the map's photos, each once."""
    near: Indices
    """(n, 2) places in `photos`."""
    far: Indices
    """(m, 2) places in `photos`."""


@dataclass(frozen=True, slots=True)
class PairSplit:
    """The lessons of both halves, and to which half (0 or 1) each of the map's photos belongs."""

    by: PairSource
    halves: list[int]
    batches: tuple[list[PairBatch], list[PairBatch]]

    def counts(self) -> list[tuple[int, int]]:
        """Near and far pairs of each half."""
        return [
            (sum(len(one.near) for one in half), sum(len(one.far) for one in half))
            for half in self.batches
        ]

    @property
    def is_enough(self) -> bool:
        return min(min(counts) for counts in self.counts()) >= MIN_PAIRS


def sample_pairs(locations: Sequence[PhotoLocation], seed: int, rows_at_once: int) -> PairSplit:
    """Up to MOST_PAIRS of each kind in each half, in lessons of up to `photos_per_lesson` photos.

    By coordinates where those give enough, else by labels; of two that are not enough the one with
    more near pairs. The same spots in the same order and the same seed give the same pairs.
    """
    found = []
    for by in PairSource:
        curriculum = _sample_from(locations, by, np.random.default_rng(seed), rows_at_once)
        if curriculum.is_enough:
            return curriculum
        found.append(curriculum)
    return max(found, key=lambda one: sum(near for near, _ in one.counts()))


def _sample_from(
    spots: Sequence[PhotoLocation], by: PairSource, rng: np.random.Generator, rows_at_once: int
) -> PairSplit:
    halves = _assign_halves([_cell(spot, by) for spot in spots], rng)
    knows: Callable[[PhotoLocation], bool] = (
        (lambda spot: spot.latitude is not None)
        if by == PairSource.COORDINATES
        else (lambda spot: spot.place is not None)
    )
    lessons: list[list[PairBatch]] = []
    for half in (0, 1):
        here = [i for i, spot in enumerate(spots) if halves[i] == half and knows(spot)]
        near = (_near_in_metres if by == PairSource.COORDINATES else _near_by_label)(
            spots, here, rng
        )
        lessons.append(_make_batches(spots, near, by, rng, rows_at_once))
    return PairSplit(by, halves, (lessons[0], lessons[1]))


def _cell(spot: PhotoLocation, by: PairSource) -> Hashable:
    """What goes into one half as a whole."""
    if spot.latitude is None or spot.longitude is None:
        return spot.place
    if by == PairSource.PLACES and spot.place is not None:
        return spot.place
    cell_degrees = math.degrees(CELL_M / EARTH_RADIUS_M)
    row = math.floor(spot.latitude / cell_degrees)
    shrunk = max(math.cos(math.radians(row * cell_degrees)), 1e-6)
    return row, math.floor(spot.longitude * shrunk / cell_degrees)


def _assign_halves(cells: Sequence[Hashable], rng: np.random.Generator) -> list[int]:
    """Each cell's half: cells come in random order, each to the half with fewer photos so far."""
    sizes: dict[Hashable, int] = {}
    for cell in cells:
        sizes[cell] = sizes.get(cell, 0) + 1
    half_of: dict[Hashable, int] = {}
    filled = [0, 0]
    order = list(sizes)
    for number in rng.permutation(len(order)).tolist():
        half = int(filled[1] < filled[0])
        half_of[order[number]] = half
        filled[half] += sizes[order[number]]
    return [half_of[cell] for cell in cells]


def _near_in_metres(
    spots: Sequence[PhotoLocation], here: Sequence[int], rng: np.random.Generator
) -> list[tuple[int, int]]:
    at = np.array(
        [(spots[i].latitude, spots[i].longitude) for i in here], dtype=np.float64
    ).reshape(-1, 2)
    order = np.argsort(at[:, 0], kind="stable")
    at = at[order]

    def partners(anchor: int) -> Indices:
        latitude, longitude = at[anchor].tolist()
        first, last = np.searchsorted(at[:, 0], latitude_bounds(latitude, NEAR_M))
        away = distances_m(latitude, longitude, at[first:last, 0], at[first:last, 1])
        found: Indices = first + np.flatnonzero((away >= NEAREST_M) & (away <= NEAR_M))
        return found

    return [
        (here[int(order[one])], here[int(order[other])])
        for one, other in _pairs_of(len(here), partners, rng)
    ]


def _near_by_label(
    spots: Sequence[PhotoLocation], here: Sequence[int], rng: np.random.Generator
) -> list[tuple[int, int]]:
    by_label: dict[str | None, list[int]] = {}
    for number, i in enumerate(here):
        by_label.setdefault(spots[i].place, []).append(number)
    members = {label: np.array(numbers) for label, numbers in by_label.items()}

    def partners(anchor: int) -> Indices:
        same = members[spots[here[anchor]].place]
        found: Indices = same[same != anchor]
        return found

    return [(here[one], here[other]) for one, other in _pairs_of(len(here), partners, rng)]


def _pairs_of(
    count: int, partners: Callable[[int], Indices], rng: np.random.Generator
) -> list[tuple[int, int]]:
    """Up to MOST_PAIRS different pairs, of photos in random order with random partners."""
    found: dict[tuple[int, int], None] = {}
    for anchor in rng.permutation(count).tolist():
        known = partners(anchor)
        chosen = rng.choice(known, size=min(PARTNERS_PER_PHOTO, len(known)), replace=False)
        for other in chosen.tolist():
            found[min(anchor, other), max(anchor, other)] = None
        if len(found) >= MAX_PAIRS:
            break
    return list(found)[:MAX_PAIRS]


def _make_batches(
    spots: Sequence[PhotoLocation],
    near: Sequence[tuple[int, int]],
    by: PairSource,
    rng: np.random.Generator,
    rows_at_once: int,
) -> list[PairBatch]:
    """The near pairs in random order, cut where a lesson is full, with as many far pairs of the
    same photos: no photo is looked at for those alone."""
    lessons: list[PairBatch] = []
    place_of: dict[int, int] = {}
    pairs: list[tuple[int, int]] = []

    def close() -> None:
        if pairs:
            photos = list(place_of)
            far = _sample_far_pairs([spots[i] for i in photos], len(pairs), by, rng)
            lessons.append(PairBatch(photos, np.array(pairs, dtype=np.int64), far))

    for number in rng.permutation(len(near)).tolist():
        new = [i for i in near[number] if i not in place_of]
        if len(place_of) + len(new) > rows_at_once:
            close()
            place_of, pairs = {}, []
        one, other = (place_of.setdefault(i, len(place_of)) for i in near[number])
        pairs.append((one, other))
    close()
    return lessons


def _sample_far_pairs(
    spots: Sequence[PhotoLocation], wanted: int, by: PairSource, rng: np.random.Generator
) -> Indices:
    """Up to `wanted` different random pairs of two places, as (m, 2) indices."""
    found: dict[tuple[int, int], None] = {}
    for one, other in rng.integers(len(spots), size=(MAX_TRIES * wanted, 2)).tolist():
        if one != other and _are_far(spots[one], spots[other], by):
            found[min(one, other), max(one, other)] = None
        if len(found) == wanted:
            break
    return np.array(list(found), dtype=np.int64).reshape(-1, 2)


def _are_far(one: PhotoLocation, other: PhotoLocation, by: PairSource) -> bool:
    if by == PairSource.PLACES:
        return one.place != other.place
    away = distance_between_m(one, other)
    return away is not None and away > FAR_M
