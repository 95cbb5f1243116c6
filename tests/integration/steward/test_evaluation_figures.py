"""Evaluations: exact figures of a map that is laid out by hand."""

from __future__ import annotations

from datetime import timedelta
from typing import Any
from uuid import UUID

import pytest
import sqlalchemy as sql

from services.steward.tasks.garbage_collection import collect_superseded_chunks
from shared.catalog.chunks import Descriptor
from shared.catalog.database.session import Catalog
from shared.catalog.maps import Map
from shared.storage.keys import thumbnail_key
from tests.integration.evaluated_map import EvaluatedMap, Watched
from tests.integration.steward.streets import HOUR, NOON, STREETS, WITHOUT_PLACE, at, query
from tests.support.catalog_rows import delete, merge_all, read_job
from tests.support.photos import near_copy, photo_bytes


def test_leave_one_out_recall_is_what_one_counts_by_hand(city: EvaluatedMap) -> None:
    city.publish(STREETS)
    city.publish(WITHOUT_PLACE)
    figures = city.figures()
    assert figures["leave_one_out"] == {
        "queries": 8,
        "R@1": 2 / 8,
        "R@5": 5 / 8,
        "R@10": 7 / 8,
        "without_positive": 7,
    }
    assert figures["labelled_queries"] is None
    assert figures["radius_m"] == 25
    (evaluation,) = city.evaluations()
    assert figures == {
        "evaluation_id": str(evaluation.id),
        "generation_id": str(city.generation_id),
        **evaluation.figures,
    }
    assert (evaluation.searchable, evaluation.labelled_queries) == (17, 0)
    assert not evaluation.automatic
    assert city.calibration() is not None


def test_second_recall_leaves_out_the_frames_of_a_walk(city: EvaluatedMap) -> None:
    """Each photo of the walk finds the next frame first; the photo of another day comes later."""
    spring = NOON + 240 * HOUR
    city.publish(
        [
            (0, at(0, filename="gate.jpg", captured_at=NOON)),
            (1, at(0, 1, filename="tree.jpg", captured_at=NOON + timedelta(seconds=60))),
            (40, at(5, filename="hall.jpg")),
            (60, at(0, filename="wall.jpg", captured_at=spring)),
            # By their numbers; no capture times.
            (180, at(1, filename="walk_0007.jpg")),
            (181, at(1, filename="walk_0067.jpg")),
            # 61 apart, and numbers in the same place of another name.
            (250, at(2, filename="walk_1000.jpg")),
            (251, at(2, filename="walk_1061.jpg")),
            (300, at(3, filename="a_1.jpg")),
            (301, at(3, filename="b_1.jpg")),
            # The name is the path.
            (330, at(4, filename="1.jpg", relative_path="north/1.jpg")),
            (331, at(4, filename="2.jpg", relative_path="south/2.jpg")),
        ]
    )
    figures = city.figures()
    assert figures["leave_one_out"] == {
        "queries": 11,
        "R@1": 10 / 11,
        "R@5": 1,
        "R@10": 1,
        "without_positive": 1,
    }
    # Of the walk, 0 and 1 find 40 before 60; 180 and 181 have nothing else at their place.
    assert figures["leave_one_out_without_sequence"] == {
        "queries": 9,
        "R@1": 6 / 9,
        "R@5": 1,
        "R@10": 1,
        "without_positive": 3,
    }


def test_a_little_farther_than_the_radius_is_another_place(city: EvaluatedMap) -> None:
    city.publish([(0, at(0)), (1, at(0, 24.9)), (90, at(1)), (91, at(1, 25.1))])
    loo = city.figures()["leave_one_out"]
    assert (loo["queries"], loo["R@1"], loo["without_positive"]) == (2, 1, 2)


def test_labelled_queries_are_counted_in_and_out_of_the_map_and_disturb_no_leave_one_out(
    city: EvaluatedMap,
) -> None:
    city.publish(STREETS)
    before = city.figures()["leave_one_out"]
    city.publish(
        [
            (1, query(**at(0, 5))),  # the first is right
            (3, query(**at(1, 5))),  # the first is right
            (120, query(place="hall")),  # third, after 100 and 50
            (30, query(**at(45))),  # nowhere
            (210, query(place="kitchen")),  # no such label
            (60, query()),  # without a known place: no query
        ]
    )
    figures = city.figures()
    assert figures["leave_one_out"] == before
    labelled = figures["labelled_queries"]
    assert labelled["queries"] == 3
    assert (labelled["R@1"], labelled["R@5"], labelled["R@10"]) == (2 / 3, 1, 1)
    assert labelled["out_of_map"] == 2
    assert labelled["same_session"] == 0
    assert labelled["median_error_of_right_ones_m"] < 25
    evaluation = city.evaluations()[-1]
    assert (evaluation.searchable, evaluation.labelled_queries) == (15, 5)


def test_a_sample_is_of_its_size_and_comes_from_its_seed(city: EvaluatedMap) -> None:
    city.publish([(7 * n, at(n)) for n in range(30)])  # each alone
    requests = [queried_photos(city, sample=10, seed=seed) for seed in (1, 1, 2)]
    # The sample comes first; then the neighbours of the photos that it finds.
    assert requests[0] == requests[1]
    assert set(requests[0][:10]) != set(requests[2][:10])
    assert all(10 <= len(ids) < 30 for ids in requests)
    assert len(queried_photos(city, sample=1000, seed=0)) == 30


def queried_photos(city: EvaluatedMap, **params: Any) -> list[UUID]:
    """The photos that an evaluation searches with; a search may be repeated with a larger k."""
    watched = Watched(city.search)
    city.start(**params)
    assert city.work(watched)
    return list(dict.fromkeys(photo for request in watched.searches for photo in request.exclude))


@pytest.mark.parametrize(
    ("later", "same"), [(11.9 * HOUR, True), (-11.9 * HOUR, True), (12 * HOUR, False)]
)
def test_queries_of_the_session_of_their_match_refine_no_probability(
    city: EvaluatedMap, later: timedelta, same: bool
) -> None:
    """40 of them are right and 20 wrong: enough to learn from, if they were of another day."""
    city.publish([(6 * n, at(n, captured_at=NOON)) for n in range(60)])
    city.publish(
        [
            (6 * n + 1, query(**at(n if n < 40 else n - 20, captured_at=NOON + later)))
            for n in range(60)
        ]
    )
    figures = city.figures()
    assert figures["labelled_queries"]["same_session"] == (60 if same else 0)
    places = figures["places"]
    refined = places is not None and places["source"] == "labelled_queries"
    assert refined != same


@pytest.mark.parametrize("known", [38, 39])
def test_denied_places_teach_beside_enough_queries_whose_place_is_known(
    city: EvaluatedMap, known: int
) -> None:
    city.publish([(6 * n, at(n)) for n in range(60)])
    city.publish([(6 * n + 1, query(**at(n))) for n in range(known)])
    denied = [{**at(n), "radius_m": 100.0, "place": None} for n in range(40, 60)]
    rows = [query(given_place={"probability": None, "denied": each}) for each in denied]
    rows[0] |= at(0)  # the true place is known meanwhile
    rows[1]["given_place"] = {"probability": None}  # a given place that was cleared
    city.publish([(6 * n + 1, row) for n, row in enumerate(rows, 40)])
    figures = city.figures()
    labelled = figures["labelled_queries"]
    assert (labelled["queries"], labelled["out_of_map"], labelled["denied"]) == (known + 1, 0, 18)
    places = figures["places"] or {"source": None}
    assert (places["source"] == "labelled_queries") == (known == 39)
    if known == 39:
        assert places["samples"] == 40 + 18
        assert places["levels"][0]["accuracy"] == pytest.approx(39 / (40 + 18))
    assert city.evaluations()[-1].labelled_queries == known + 1


def test_a_photo_deleted_meanwhile_counts_neither_way(city: EvaluatedMap, catalog: Catalog) -> None:
    photo_ids = city.publish([(0, at(0)), (1, at(0)), (90, at(1)), (91, at(1))])
    asking = city.publish([(2, query(**at(0))), (92, query(**at(1)))])
    job_id = city.start()

    def delete_some() -> None:
        for gone in (photo_ids[3], asking[1]):
            delete(catalog, city.map_id, gone)
            _forget(catalog, gone)

    city.work(Watched(city.search, 1, delete_some))
    result = read_job(catalog, job_id).result
    assert result is not None
    assert result["leave_one_out"]["queries"] == 3
    assert result["leave_one_out"]["R@1"] == pytest.approx(2 / 3), "the pair of the gone one"
    assert (result["labelled_queries"]["queries"], result["labelled_queries"]["R@1"]) == (1, 1)


def test_own_photos_are_searched_without_their_copies(city: EvaluatedMap) -> None:
    """A copy stands beside every second photo; next to it are photos of other places."""
    photos = [(n, make) for n in range(20) for make in (photo_bytes, near_copy)[: 1 + n % 2]]
    spots = [(18 * n + (make is near_copy), {"place": str(n % 10)}) for n, make in photos]
    for photo_id, (n, make) in zip(city.publish(spots), photos, strict=True):
        city.store.put(thumbnail_key(photo_id), make(n))
    assert city.figures()["places"]["levels"][0]["accuracy"] == 0


def _forget(catalog: Catalog, photo_id: UUID) -> None:
    with catalog.write() as session:
        session.execute(sql.delete(Descriptor).where(Descriptor.photo_id == photo_id))


def test_chunks_merged_and_removed_meanwhile_change_no_figure(city: EvaluatedMap) -> None:
    """The query photo has another reference then: it is looked up again."""
    for begin in range(0, len(STREETS), 3):
        city.publish(STREETS[begin : begin + 3])
    before = city.figures()["leave_one_out"]

    def merge() -> None:
        assert merge_all(city.catalog, city.store, city.generation_id)
        collect_superseded_chunks(city.catalog, city.store, grace_seconds=0)
        city.search.sync()

    job_id = city.start()
    city.work(Watched(city.search, 4, merge))
    result = read_job(city.catalog, job_id).result
    assert result is not None
    assert result["leave_one_out"] == before


def _label(kind: str, place: int) -> str | None:
    """The label of a place, of a kind that an evaluation must not stumble over."""
    floor = place % 4
    labels: dict[str, tuple[str | None, ...]] = {
        "empty levels": (f"tower//room {place}", f"/tower/ /room {place}", "//", "tower/"),
        "mixed depths": ("tower", f"tower/{floor}", f"tower/{floor}/{place}/shelf/left", None),
    }
    return labels[kind][place % len(labels[kind])]


def _publish_pairs(city: EvaluatedMap, places: int, **columns: Any) -> None:
    """Two photos of each place side by side; `columns` compute their values from the place."""
    city.publish(
        [
            (
                place * 360 / places + view * 90 / places,
                {key: value(place) for key, value in columns.items()},
            )
            for place in range(places)
            for view in range(2)
        ]
    )


def _use_paths(city: EvaluatedMap) -> None:
    with city.catalog.write() as session:
        map_ = session.get_one(Map, city.map_id)
        map_.place_labels_are_paths, map_.place_labels_are_automatic = True, False


@pytest.mark.parametrize(("kind", "max_levels"), [("empty levels", 2), ("mixed depths", 5)])
def test_labels_with_empty_levels_or_mixed_depths_are_evaluated(
    city: EvaluatedMap, kind: str, max_levels: int
) -> None:
    _use_paths(city)
    _publish_pairs(city, 40, place=lambda place: _label(kind, place))
    places = city.figures()["places"]
    assert places["source"] == "own_photos"
    assert 1 <= len(places["levels"]) <= max_levels
    assert places["levels"][0]["samples"] > 0
    for answers in places["answers"]:
        assert 0 <= answers["answered_at_finest_level"]["mean"] <= answers["answered"]["mean"] <= 1


@pytest.mark.parametrize(
    ("columns", "levels"),
    [
        ({"place": lambda place: f"tower/{place % 4}/{place}"}, 3),
        ({"place": lambda place: f"room {place}"}, 2),
        (
            {
                "place": lambda place: f"tower/{place % 4}/{place}",
                "latitude": float,
                "longitude": lambda _: 7.0,
            },
            5,
        ),
    ],
    ids=["paths", "names", "paths beside coordinates"],
)
def test_an_evaluation_decides_by_the_labels_whether_they_are_paths(
    city: EvaluatedMap, columns: dict[str, Any], levels: int
) -> None:
    _publish_pairs(city, 40, **columns)
    assert len(city.figures()["places"]["levels"]) == levels
    with city.catalog.read() as session:
        assert session.get_one(Map, city.map_id).place_labels_are_paths == (levels == 3)


@pytest.mark.parametrize("labels_are_paths", [False, True])
def test_labels_that_disagree_with_the_coordinates_are_evaluated(
    city: EvaluatedMap, labels_are_paths: bool
) -> None:
    if labels_are_paths:
        _use_paths(city)
    _publish_pairs(
        city,
        40,
        place=lambda place: f"tower/{place % 4}/{place}",
        latitude=lambda place: float(place * 7 % 40),
        longitude=lambda _: 7.0,
    )
    city.publish([(1, at(39, place="tower/0/0"))])  # the label of one place, the spot of another
    places = city.figures()["places"]
    assert places["source"] == "own_photos"
    assert len(places["levels"]) == (3 if labels_are_paths else 5)
    assert places["levels"][-1]["accuracy"] > 0.5
