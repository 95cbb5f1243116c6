"""The photos of a map as a track's filter reads them from the catalog, beside those of arrays."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from sqlalchemy import delete, insert, select

from lab.evaluation.array_photo_graph import ArrayPhotoGraph
from services.gateway.tracks import catalog_graph
from services.gateway.tracks.catalog_graph import CatalogPhotoGraph
from services.steward.tasks.maintenance import update_statistics_of_large_maps
from shared.catalog.database.base import db_now
from shared.catalog.database.session import Catalog
from shared.catalog.photos import Photo, PhotoRole
from shared.jobs import Job, JobKind
from shared.tracks import filter as filter_module
from shared.tracks.belief import Belief
from shared.tracks.evidence import FrameEvidence, Hit, PositionFix
from shared.tracks.filter import TrackFilter
from shared.tracks.photo_graph import FloatArray, PhotoTable, distance_matrix_m
from tests.support.catalog_rows import add_job, add_map, add_photo, made_up_photo

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)
CENTERS = [(45.0, 7.0), (10.0, 180.0), (89.9999, 30.0)]


@pytest.fixture
def map_id(catalog: Catalog) -> UUID:
    """Photos around some points, and photos with times and labels instead of coordinates."""
    rng = np.random.default_rng(0)
    with catalog.write() as session:
        made = add_map(session)
        for latitude, longitude in CENTERS:
            for north, east in rng.uniform(-1e-3, 1e-3, (40, 2)).tolist():
                add_photo(
                    session,
                    made.id,
                    latitude=min(latitude + north, 90.0),
                    longitude=(longitude + east + 180) % 360 - 180,
                    heading=90.0,
                )
        for second in range(60):
            place = f"room {second // 20}" if second % 10 == 0 else None
            time = NOON + timedelta(seconds=second)
            add_photo(session, made.id, captured_at=time, place=place)
        add_photo(session, made.id, latitude=45.0, longitude=7.0, deleted_at=db_now())
        add_photo(session, made.id, latitude=45.0, longitude=7.0, role=PhotoRole.QUERY)
        add_photo(session, add_map(session, "other").id, latitude=45.0, longitude=7.0)
        return made.id


def ids_of(table: PhotoTable) -> set[str]:
    ids: list[str] = table.ids.tolist()
    assert len(ids) == len(set(ids)), "each photo once"
    return set(ids)


@pytest.mark.databases("sqlite", "postgresql")
def test_the_graph_of_the_catalog_equals_that_of_arrays(catalog: Catalog, map_id: UUID) -> None:
    with catalog.read() as session:
        graph = CatalogPhotoGraph(session, map_id)
        assert graph.photo_count == 180
        everywhere = [graph.near(*center, 1000.0, 40)[0] for center in CENTERS]
        assert [len(table) for table in everywhere] == [40, 40, 40]
        labelled = session.scalars(select(Photo.id).where(Photo.place == "room 0"))
        by_time = graph.photos([str(photo_id) for photo_id in labelled])
        assert len(by_time) == 2
        all_times, is_all = graph.around(by_time, 1.0, 100.0, 60)
        assert (len(all_times), is_all) == (60, True)
        assert graph.around(by_time, 1.0, 100.0, 59)[1] is False
        arrays = ArrayPhotoGraph(all_times.union(*everywhere))
        for table in everywhere:
            for reach_m in (5.0, 40.0):
                some = table.take(np.arange(0, 40, 7))
                expected, _ = arrays.around(some, reach_m, 1.0, 99)
                found, is_all = graph.around(some, reach_m, 1.0, 99)
                assert is_all
                assert ids_of(expected) <= ids_of(found)
                assert ids_of(found) <= ids_of(arrays.around(some, reach_m + 250.0, 1.0, 99)[0])
            center = (float(table.latitudes[0]), float(table.longitudes[0]))
            near, is_all = graph.near(*center, 30.0, 99)
            assert is_all
            assert ids_of(near) == ids_of(arrays.near(*center, 30.0, 99)[0])
            for some_graph in (graph, arrays):
                few, is_all = some_graph.near(*center, 1000.0, 39)
                assert (len(few), is_all) == (39, False)
        for seconds in (1.0, 3.5):
            sources = all_times.take(np.array([0, 25]))
            found, _ = graph.around(sources, 5.0, seconds, 99)
            assert ids_of(found) == ids_of(arrays.around(sources, 5.0, seconds, 99)[0])
        labels = [f"room {number}" for number in range(4)]
        assert graph.count_labels(labels) == arrays.count_labels(labels)
        known = sorted(ids_of(all_times))
        assert ids_of(graph.photos([*known, str(UUID(int=1))])) == set(known)
        assert len(graph.photos([])) == 0


@pytest.mark.parametrize(
    ("is_located", "fix"),
    [(True, PositionFix(latitude=45.0, longitude=7.0, accuracy_m=100_000.0)), (False, None)],
    ids=["a fix of 100 km", "a label without positions"],
)
def test_the_size_of_a_step_does_not_depend_on_the_number_of_photos_at_a_fix_or_label(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch, is_located: bool, fix: PositionFix | None
) -> None:
    most_near, most_photos, most_of_label = 60, 20, 30
    monkeypatch.setattr(filter_module, "MAX_PHOTOS", most_photos)
    for module in (filter_module, catalog_graph):
        monkeypatch.setattr(module, "MAX_SAME_LABEL", most_of_label)
    monkeypatch.setattr(filter_module, "MAX_NEAR", most_near)
    with catalog.write() as session:
        map_id = add_map(session).id
        rows = [
            made_up_photo(
                map_id,
                place="town",
                latitude=45 + number * 1e-5 if is_located else None,
                longitude=7.0 if is_located else None,
                captured_at=NOON + timedelta(seconds=number),
            )
            for number in range(600)
        ]
        session.execute(insert(Photo), rows)
    hits = tuple(Hit(photo=str(row["id"]), score=1.0, probability=0.04) for row in rows[::60])
    frames = [
        FrameEvidence(time=NOON + timedelta(seconds=30 * number), hits=hits, fix=fix)
        for number in range(3)
    ]
    sizes: list[int] = []

    def record(sources: PhotoTable, targets: PhotoTable, speed: float) -> FloatArray:
        sizes.append(len(targets))
        return distance_matrix_m(sources, targets, speed)

    monkeypatch.setattr(filter_module, "distance_matrix_m", record)
    read_rows = CatalogPhotoGraph._table

    def read(self: CatalogPhotoGraph, rows: Iterable[Any]) -> PhotoTable:
        table = read_rows(self, rows)
        sizes.append(len(table))
        return table

    monkeypatch.setattr(CatalogPhotoGraph, "_table", read)
    with catalog.read() as session:
        track_filter = TrackFilter(CatalogPhotoGraph(session, map_id))
        smoothed = track_filter.smooth(frames)
    for each in smoothed:
        assert len(Belief.from_bytes(each.to_bytes()).photos) <= most_photos + len(hits)
    assert most_near < max(sizes) <= most_photos + len(hits) + 2 * most_near


@pytest.mark.databases("sqlite", "postgresql")
def test_the_photos_of_a_map_that_is_no_longer_large_are_counted_again(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The statistics of a map with many jobs are cached, until these were deleted by their age."""
    monkeypatch.setattr("shared.catalog.maps.MAX_EXACT_COUNT", 20)

    def count_after_the_steward(map_id: UUID) -> int:
        update_statistics_of_large_maps(catalog)
        with catalog.read() as session:
            return CatalogPhotoGraph(session, map_id).photo_count

    with catalog.write() as session:
        map_id = add_map(session).id
        for _ in range(2):
            add_photo(session, map_id)
        for _ in range(21):
            add_job(session, map_id, JobKind.DESCRIBE)
    assert count_after_the_steward(map_id) == 2
    with catalog.write() as session:
        session.execute(delete(Job))
        for _ in range(10):
            add_photo(session, map_id)
    assert count_after_the_steward(map_id) == 12
