"""The photos of a map as a track's filter reads them from the catalog, beside those of arrays."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from uuid import UUID

import numpy as np
import pytest
from sqlalchemy import delete

from services.gateway.tracks.catalog_graph import CatalogPhotoGraph
from services.steward.tasks.maintenance import update_statistics_of_large_maps
from shared.catalog.database.base import db_now
from shared.catalog.database.session import Catalog
from shared.catalog.photos import PhotoRole
from shared.jobs import Job, JobKind
from shared.tracks.photo_graph import ArrayPhotoGraph, PhotoTable
from tests.support.catalog_rows import add_job, add_map, add_photo

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


def test_the_catalog_answers_as_arrays_do(catalog: Catalog, map_id: UUID) -> None:
    with catalog.read() as session:
        graph = CatalogPhotoGraph(session, map_id)
        assert graph.photo_count == 180
        everywhere = [graph.near(*center, 1000.0) for center in CENTERS]
        assert [len(table) for table in everywhere] == [40, 40, 40]
        by_time = graph.labelled("room 0")
        assert len(by_time) == 2
        all_times = graph.around(by_time, 1.0, 100.0)
        assert len(all_times) == 60
        arrays = ArrayPhotoGraph(all_times.union(*everywhere))
        for table in everywhere:
            for reach_m in (5.0, 40.0):
                some = table.take(np.arange(0, 40, 7))
                expected = ids_of(arrays.around(some, reach_m, 1.0))
                found = graph.around(some, reach_m, 1.0)
                assert expected <= ids_of(found)
                assert ids_of(found) <= ids_of(arrays.around(some, reach_m + 250.0, 1.0))
            center = (float(table.latitudes[0]), float(table.longitudes[0]))
            assert ids_of(graph.near(*center, 30.0)) == ids_of(arrays.near(*center, 30.0))
        for seconds in (1.0, 3.5):
            sources = all_times.take(np.array([0, 25]))
            found = graph.around(sources, 5.0, seconds)
            assert ids_of(found) == ids_of(arrays.around(sources, 5.0, seconds))
        known = sorted(ids_of(all_times))
        assert ids_of(graph.photos([*known, str(UUID(int=1))])) == set(known)
        assert len(graph.photos([])) == 0


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
