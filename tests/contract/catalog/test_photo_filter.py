"""A filter means the same to a metadata search, in SQL, and to a similarity search, in the scan."""

from __future__ import annotations

from uuid import UUID

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as some
from sqlalchemy import delete, select

from services.gateway.photo_search import filter_conditions
from services.search.photo_columns import PhotoColumns, build_row_mask
from shared.catalog.database.session import Catalog
from shared.catalog.photos import Photo, PhotoFilterValues, PhotoRole
from shared.search_api.photo_filter import Box, Circle, PhotoFilter
from tests.support.catalog_rows import add_photo
from tests.unit.search.photo_filters import HALF_EARTH_M, IDS, passes, photo_facts, photo_filters

FILTERS = 25  # for each population of photos


def store(
    catalog: Catalog, map_id: UUID, photos: list[PhotoFilterValues]
) -> list[PhotoFilterValues]:
    """Exactly these photos lie in the catalog; what search reads of them."""
    with catalog.write() as session:
        session.execute(delete(Photo))
        for photo in photos:
            add_photo(
                session,
                map_id,
                id=photo.photo_id,
                role=photo.role,
                latitude=photo.latitude,
                longitude=photo.longitude,
                captured_at=photo.captured_at,
                place=photo.place,
                tags=photo.tags,
            )
    with catalog.read() as session:
        found = session.execute(select(*PhotoFilterValues.COLUMNS).order_by(Photo.id))
        return [PhotoFilterValues(*facts) for facts in found]


def in_sql(catalog: Catalog, photo_filter: PhotoFilter) -> set[UUID]:
    with catalog.read() as session:
        return set(session.scalars(select(Photo.id).where(*filter_conditions(photo_filter))))


def in_scan(photos: list[PhotoFilterValues], photo_filter: PhotoFilter) -> set[UUID]:
    columns = PhotoColumns.of(len(photos), enumerate(photos))
    return set(columns.photo_id[build_row_mask(columns, photo_filter, ())])


def test_sql_and_the_scan_let_pass_what_the_filter_means(catalog: Catalog, map_id: UUID) -> None:
    @settings(
        max_examples=8,
        phases=[Phase.generate],  # shrinking would store thousands of populations
        suppress_health_check=list(HealthCheck),
    )
    @given(data=some.data())
    def agree(data: some.DataObject) -> None:
        drawn = [data.draw(photo_facts(photo_id)) for photo_id in IDS[:30]]
        photos = store(catalog, map_id, drawn)
        for _ in range(FILTERS):
            photo_filter = data.draw(photo_filters(photos))
            sql, scan = in_sql(catalog, photo_filter), in_scan(photos, photo_filter)
            for photo in photos:
                expected = passes(photo, photo_filter)
                if expected is None:
                    continue
                here = (photo, photo_filter)
                assert (photo.photo_id in sql) == expected, here
                findable = photo.role == PhotoRole.DATABASE
                assert (photo.photo_id in scan) == (expected and findable), here

    agree()


def test_denormal_coordinates_fail_no_search(catalog: Catalog, map_id: UUID) -> None:
    """PostgreSQL raises where a square underflows: one such photo would end every search."""
    tiny = 5e-324
    with catalog.write() as session:
        odd = add_photo(session, map_id, latitude=tiny, longitude=-tiny).id
        far = add_photo(session, map_id, latitude=1e-200, longitude=180).id
    for centre in (0.0, tiny, -1e-300):
        circle = Circle(latitude=centre, longitude=centre, radius_m=0)
        assert in_sql(catalog, PhotoFilter(near=circle)) == {odd}
        larger = circle.model_copy(update={"radius_m": HALF_EARTH_M})
        assert in_sql(catalog, PhotoFilter(near=larger)) == {odd, far}
    assert in_sql(catalog, PhotoFilter(box=Box(south=0, west=0, north=0, east=tiny))) == {odd}
