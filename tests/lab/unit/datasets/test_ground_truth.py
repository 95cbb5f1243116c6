"""Who is right for whom, by each rule; distances against the full matrix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import utm
from hypothesis import given
from hypothesis import strategies as st

from lab.datasets.dataset import DatasetPhoto
from lab.datasets.ground_truth import PositiveRule, find_positives, parse_rule
from lab.datasets.utm_coordinates import pairwise_distances_m
from lab.evaluation.recall import positives_within
from shared.errors import InvalidRequest
from shared.geodesy import distance_m
from tests.lab.unit.data_sets import refused


def shot(**fields: object) -> DatasetPhoto:
    return DatasetPhoto(Path("photo.jpg"), "photo.jpg", **fields)  # type: ignore[arg-type]


def at(east: float, north: float, zone: str | None = None, **fields: object) -> DatasetPhoto:
    return shot(easting=east, northing=north, zone=zone, **fields)


def on_earth(latitude: float, longitude: float) -> DatasetPhoto:
    """A photo in the zone that it lies in, its metres to the centimetre as file names have them."""
    east, north, number, letter = utm.from_latlon(latitude, longitude)
    return at(round(float(east), 2), round(float(north), 2), f"{number}{letter}")


def positives(
    rule: str, queries: list[DatasetPhoto], database: list[DatasetPhoto]
) -> list[list[int]]:
    return [found.tolist() for found in find_positives(parse_rule(rule), queries, database)]


def by_full_matrix(
    queries: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    database: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    within_m: float,
) -> list[list[int]]:
    away = queries[:, None] - database[None]
    near = away[..., 0] ** 2 + away[..., 1] ** 2 <= within_m**2
    return [np.flatnonzero(row).tolist() for row in near]


# Tenths of metres around one point, so that many pairs are close to the bound or right on it.
spots = st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 2000)), min_size=0, max_size=40)


@given(spots, spots, st.sampled_from([0.0, 0.1, 5.0, 25.0, 60.0, 500.0]))
def test_positives_are_those_of_the_full_matrix(
    query_positions: list[tuple[int, int]],
    database_positions: list[tuple[int, int]],
    within_m: float,
) -> None:
    queries = np.array(query_positions, np.float64).reshape(-1, 2) / 10 + (480_000.0, 4_880_000.0)
    database = np.array(database_positions, np.float64).reshape(-1, 2) / 10 + (
        480_000.0,
        4_880_000.0,
    )
    found = positives_within(queries, database, within_m)
    assert [row.tolist() for row in found] == by_full_matrix(queries, database, within_m)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("radius", PositiveRule("radius", radius_m=25)),
        ("Radius 2.5 m", PositiveRule("radius", radius_m=2.5)),
        ("heading:25m,40", PositiveRule("heading", radius_m=25, degrees=40)),
        ("heading 10 30", PositiveRule("heading", radius_m=10, degrees=30)),
        ("frames 5", PositiveRule("frames", frames=5)),
        ("frames 2 in sequence", PositiveRule("frames", frames=2, same_sequence=True)),
        ("place-label", PositiveRule("place-label")),
    ],
)
def test_rules_round_trip_as_text(text: str, rule: PositiveRule) -> None:
    assert parse_rule(text) == rule
    assert parse_rule(str(rule)) == rule


@pytest.mark.parametrize("text", ["25", "radius -3", "heading 25 400"])
def test_unknown_rule_names_those_that_are_known(text: str) -> None:
    with refused("unknown_rule", "place-label"):
        parse_rule(text)


def test_letters_of_one_zone_are_one_plane_and_other_zones_are_another_place() -> None:
    queries = [at(480_000, 5_318_000, "32T")]
    database = [at(480_000, 5_318_020, "32U"), at(480_000, 5_318_000, "33T")]
    assert positives("radius", queries, database) == [[0]]


def test_equator_and_antimeridian_part_no_neighbours() -> None:
    equator = positives("radius", [on_earth(0.00001, 9.0)], [on_earth(-0.00001, 9.0)])
    dateline = positives("radius", [on_earth(-17.0, 179.9999)], [on_earth(-17.0, -179.9999)])
    assert (equator, dateline) == ([[0]], [[0]])


@given(
    st.floats(-60, 60),
    st.floats(-180, 180),
    st.lists(st.tuples(st.floats(-3e-4, 3e-4), st.floats(-3e-4, 3e-4)), min_size=1, max_size=12),
)
def test_positives_over_zones_agree_with_distances_on_the_earth(
    latitude: float, longitude: float, steps: list[tuple[float, float]]
) -> None:
    def wrapped(degrees: float) -> float:
        return (degrees + 180) % 360 - 180

    border = wrapped(round(longitude / 6) * 6)
    query = (latitude, wrapped(border + 1e-5))
    database = [(latitude + up, wrapped(border + along)) for up, along in steps]
    (found,) = positives("radius 25", [on_earth(*query)], [on_earth(*spot) for spot in database])
    for number, spot in enumerate(database):
        metres = distance_m(*query, *spot)
        if abs(metres - 25) > 0.3:  # sphere and ellipsoid differ by up to 0.6 %, UTM by 0.1 %
            assert (number in found) == (metres < 25)


def test_photos_without_a_zone_are_refused_only_among_several_zones() -> None:
    here = at(480_000, 4_880_000)
    assert positives("radius", [here], [at(480_010, 4_880_000, "32T")]) == [[0]]
    with refused("no_utm_zone"):
        positives("radius", [here], [on_earth(48, 11.9), on_earth(48, 12.1)])


def test_latitude_and_longitude_alone_are_enough() -> None:
    query = shot(latitude=44.07, longitude=8.76)
    near, far = shot(latitude=44.0701, longitude=8.76), shot(latitude=44.08, longitude=8.76)
    assert positives("radius", [query], [far, near]) == [[1]]


def test_photo_without_a_position_is_named_and_another_rule_proposed() -> None:
    with refused("no_positions", r"photo\.jpg.*place-label"):
        positives("radius", [at(0, 0)], [shot()])


def test_heading_rule_wants_near_photos_that_look_the_same_way() -> None:
    database = [at(0, 0, heading=350), at(10, 0, heading=31), at(20, 0, heading=10)]
    database += [at(26, 0, heading=10), at(0, 1, heading=50), at(0, 2, heading=51)]
    assert positives("heading 25 40", [at(0, 0, heading=10)], database) == [[0, 1, 2, 4]]
    with pytest.raises(InvalidRequest, match="1 photos have no heading"):
        positives("heading", [at(0, 0)], database)


def test_frames_rule_counts_frames_and_can_stay_within_a_sequence() -> None:
    frames = [(3, "b"), (7, "a"), (5, "a"), (8, "a"), (4, "b")]
    database = [shot(frame=frame, sequence=sequence) for frame, sequence in frames]
    query = shot(frame=5, sequence="a")
    assert positives("frames 2", [query], database) == [[0, 1, 2, 4]]
    assert positives("frames 2 in sequence", [query], database) == [[1, 2]]
    assert positives("frames 2 in sequence", [shot(frame=5, sequence="c")], database) == [[]]


def test_place_rule_matches_labels_and_a_photo_without_one_matches_none() -> None:
    database = [shot(place="hall"), shot(), shot(place="door"), shot(place="hall")]
    queries = [shot(place="hall"), shot(), shot(place="roof")]
    assert positives("place-label", queries, database) == [[0, 3], [], []]
    with refused("no_places"):
        positives("place-label", queries, [shot()])


def test_metres_apart_are_straight_in_a_zone_and_over_its_border_those_of_the_earth() -> None:
    west, east = on_earth(48.0, 11.999), on_earth(48.0, 12.001)
    metres = pairwise_distances_m([west, at(0, 0), west], [east, at(3, 4), shot()])
    assert metres[0] == pytest.approx(distance_m(48.0, 11.999, 48.0, 12.001), abs=0.02)
    assert metres[1] == 5
    assert np.isnan(metres[2])
