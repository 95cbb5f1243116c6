"""Which rows a filter lets pass: the mask against a reference of its own, photo by photo."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from services.search.photo_columns import PhotoColumns, build_row_mask
from shared.catalog.photos import PhotoFilterValues, PhotoRole
from shared.search_api.photo_filter import NO_FILTER, Box, Circle, PhotoFilter
from tests.unit.search.photo_filters import HALF_EARTH_M, IDS, passes, photo_facts, photo_filters
from tests.unit.search.search_rows import facts_of

MOMENT = datetime(2024, 5, 6, 7, 8, 9, 123456, tzinfo=UTC)


def selected(photos: list[PhotoFilterValues], photo_filter: PhotoFilter) -> list[UUID]:
    columns = PhotoColumns.of(len(photos), enumerate(photos))
    return list(columns.photo_id[build_row_mask(columns, photo_filter, ())])


@settings(max_examples=60)
@given(data=some.data(), count=some.integers(1, 12))
def test_filter_mask_selects_the_photos_that_match_the_filter(
    data: some.DataObject, count: int
) -> None:
    photos = [data.draw(photo_facts(photo_id)) for photo_id in IDS[:count]]
    photo_filter = data.draw(photo_filters(photos))
    found = selected(photos, photo_filter)
    for photo in photos:
        expected = passes(photo, photo_filter)
        if expected is not None:
            findable = photo.role == PhotoRole.DATABASE
            assert (photo.photo_id in found) == (expected and findable), (photo, photo_filter)


@settings(max_examples=20)
@given(data=some.data())
def test_filter_mask_leaves_out_excluded_deleted_and_query_photos(data: some.DataObject) -> None:
    photos = [data.draw(photo_facts(photo_id)) for photo_id in IDS[:6]]
    columns = PhotoColumns.of(8, enumerate(photos))  # the last two rows belong to no photo
    excluded = frozenset(data.draw(some.sets(some.sampled_from(IDS[:8]))))
    found = columns.photo_id[build_row_mask(columns, NO_FILTER, excluded)]
    assert list(found) == [
        photo.photo_id
        for photo in photos
        if photo.role == PhotoRole.DATABASE and photo.photo_id not in excluded
    ]


@pytest.mark.parametrize(
    ("photo_filter", "passing"),
    [
        (PhotoFilter(), "west east pole nowhere"),
        (PhotoFilter(ids=(IDS[1], IDS[1], IDS[39])), "east"),
        (PhotoFilter(box=Box(south=-1, west=179, north=1, east=-179)), "west east"),
        (PhotoFilter(box=Box(south=0, west=180, north=0, east=180)), "west"),
        (PhotoFilter(box=Box(south=-90, west=-180, north=90, east=180)), "west east pole"),
        (PhotoFilter(box=Box(south=80, west=0, north=90, east=1)), "pole"),
        (PhotoFilter(near=Circle(latitude=89.9, longitude=-60, radius_m=12_000)), "pole"),
        (PhotoFilter(near=Circle(latitude=0, longitude=180, radius_m=112_000)), "west east"),
        (PhotoFilter(near=Circle(latitude=0, longitude=-179, radius_m=0)), "east"),
        (
            PhotoFilter(near=Circle(latitude=-33, longitude=12, radius_m=HALF_EARTH_M)),
            "west east pole",
        ),
    ],
)
def test_boxes_and_circles_cross_the_antimeridian_and_the_poles(
    photo_filter: PhotoFilter, passing: str
) -> None:
    names = {IDS[0]: "west", IDS[1]: "east", IDS[2]: "pole", IDS[3]: "nowhere"}
    photos = [
        facts_of(IDS[0], latitude=0, longitude=-180),
        facts_of(IDS[1], latitude=0, longitude=-179),
        facts_of(IDS[2], latitude=90, longitude=123),
        facts_of(IDS[3]),
    ]
    assert [names[photo_id] for photo_id in selected(photos, photo_filter)] == passing.split()


def test_bounds_of_the_time_are_inclusive_to_the_microsecond() -> None:
    step = timedelta(microseconds=1)
    photos = [facts_of(IDS[n], captured_at=MOMENT + (n - 1) * step) for n in range(3)]
    photos.append(facts_of(IDS[3]))
    elsewhere = MOMENT.astimezone(timezone(timedelta(hours=9)))
    assert selected(photos, PhotoFilter(captured_after=elsewhere)) == IDS[1:3]
    assert selected(photos, PhotoFilter(captured_before=elsewhere)) == IDS[:2]
    both = PhotoFilter(captured_after=elsewhere, captured_before=elsewhere)
    assert selected(photos, both) == [IDS[1]]
    assert selected(photos, PhotoFilter(captured_after=MOMENT + 9 * step)) == []


def test_updated_photo_columns_do_not_change_earlier_snapshots() -> None:
    """Queries under way go on with the snapshot that they began with."""
    before = PhotoColumns.of(2, enumerate([facts_of(IDS[0], place="hall"), facts_of(IDS[1])]))
    after = before.with_changes(
        {IDS[1]: facts_of(IDS[1], place="hall", tags=("wet",), latitude=1.0)}
    )
    in_hall = PhotoFilter(place="hall")
    assert list(build_row_mask(before, in_hall, ())) == [True, False]
    assert list(build_row_mask(after, in_hall, ())) == [True, True]
    assert np.isnan(before.latitude[1])
    assert before.with_changes({IDS[7]: facts_of(IDS[7])}) is before
