"""Metadata search: filters, cursors and totals, on both databases."""

from __future__ import annotations

import random
from collections.abc import Callable
from datetime import timedelta, timezone
from typing import Any
from uuid import UUID

from sqlalchemy import text

from services.gateway.photo_search import MetadataSearchParams, search_photos
from shared.catalog.database.session import Catalog
from shared.catalog.photos import Photo, PhotoRole
from tests.contract.catalog.test_session import MOMENT
from tests.support.catalog_rows import add_job, add_map, add_photo


def found(catalog: Catalog, map_id: UUID, **params: Any) -> set[str]:
    """The names of all photos that match, with the total checked against them."""
    for name in params.keys() & {"upload_after", "upload_before"}:
        params[name] = params[name].isoformat()
    with catalog.read() as session:
        page, total = search_photos(session, map_id, MetadataSearchParams(**params), 1000, None)
    assert total == len(page)
    return {photo.filename for photo in page}


def test_a_photo_is_found_by_a_part_of_its_name_or_relative_path_in_any_case(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        for name in ("Market-Street.JPG", "market hall.png", "harbour.jpg"):
            add_photo(session, map_id, filename=name)
    assert found(catalog, map_id, filename="MARKET") == {"Market-Street.JPG", "market hall.png"}
    assert found(catalog, map_id, filename="street.jpg") == {"Market-Street.JPG"}
    assert found(catalog, map_id, filename="square") == set()
    assert found(catalog, map_id) == {"Market-Street.JPG", "market hall.png", "harbour.jpg"}
    with catalog.write() as session:
        add_photo(session, map_id, filename="1.jpg", relative_path="Spring/old_town/1.jpg")
        add_photo(session, map_id, filename="2.jpg", relative_path="autumn/2.jpg")
        add_photo(session, map_id, filename="spring.jpg")
    assert found(catalog, map_id, filename="spring") == {"1.jpg", "spring.jpg"}
    assert found(catalog, map_id, filename="ring/OLD_") == {"1.jpg"}
    assert found(catalog, map_id, filename="ring/old%") == set()


def test_wildcards_in_a_file_name_are_ordinary_characters(catalog: Catalog, map_id: UUID) -> None:
    specials = ["%", "_", "/", "\\", "'", '"', "[a-z]", "*", "?"]
    with catalog.write() as session:
        for special in specials:
            add_photo(session, map_id, filename=f"a{special}b.jpg")
        add_photo(session, map_id, filename="axb.jpg")
        add_photo(session, map_id, filename="ab.jpg")
    for special in specials:
        assert found(catalog, map_id, filename=special) == {f"a{special}b.jpg"}
        assert found(catalog, map_id, filename=f"a{special}b") == {f"a{special}b.jpg"}


def test_bounds_of_time_are_inclusive_to_the_microsecond(catalog: Catalog, map_id: UUID) -> None:
    step = timedelta(microseconds=1)
    with catalog.write() as session:
        for name, at in (("early", -1), ("exact", 0), ("late", 1)):
            add_photo(session, map_id, filename=name, uploaded_at=MOMENT + at * step)
    assert found(catalog, map_id, upload_after=MOMENT) == {"exact", "late"}
    assert found(catalog, map_id, upload_before=MOMENT) == {"early", "exact"}
    assert found(catalog, map_id, upload_after=MOMENT, upload_before=MOMENT) == {"exact"}
    elsewhere = MOMENT.astimezone(timezone(timedelta(hours=-7)))
    assert found(catalog, map_id, upload_after=elsewhere, upload_before=elsewhere) == {"exact"}
    whole = MOMENT.replace(microsecond=0)
    with catalog.write() as session:
        add_photo(session, map_id, filename="whole", uploaded_at=whole)
    assert found(catalog, map_id, upload_before=whole) == {"whole"}
    assert found(catalog, map_id, upload_after=whole) == {"whole", "early", "exact", "late"}


def test_bounds_of_size_are_inclusive_and_large(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        for size in (0, 999, 1000, 2**40):
            add_photo(session, map_id, filename=str(size), size_bytes=size)
    assert found(catalog, map_id, min_file_size=999) == {"999", "1000", str(2**40)}
    assert found(catalog, map_id, max_file_size=999) == {"0", "999"}
    assert found(catalog, map_id, min_file_size=0, max_file_size=0) == {"0"}
    assert found(catalog, map_id, min_file_size=2**40) == {str(2**40)}


def test_filters_work_together_in_one_map_and_role(catalog: Catalog, map_id: UUID) -> None:
    params: dict[str, Any] = {
        "filename": "x.jpg",
        "tags": ["t"],
        "size_bytes": 5,
        "uploaded_at": MOMENT,
        "latitude": 45.07,
        "longitude": 7.69,
        "place": "hall",
    }
    others: list[dict[str, Any]] = [
        *({"filename": "y.jpg"}, {"tags": ["u"]}, {"size_bytes": 6}),
        *({"uploaded_at": MOMENT + timedelta(days=1)}, {"latitude": 45.08}, {"place": None}),
    ]
    with catalog.write() as session:
        other = add_map(session, "other").id
        right = add_photo(session, map_id, **params).id
        asking = add_photo(session, map_id, **params, role=PhotoRole.QUERY).id
        add_photo(session, other, **params)
        for wrong in others:
            add_photo(session, map_id, **(params | wrong))
    query: dict[str, Any] = {
        "filename": "x",
        "upload_before": MOMENT.isoformat(),
        "max_file_size": 5,
        "tags": "t",
        "place": "hall",
        "near": "45.0701,7.69,100",
    }
    for role, expected in (
        (PhotoRole.DATABASE, {right}),
        (PhotoRole.QUERY, {asking}),
        (None, {right, asking}),
    ):
        with catalog.read() as session:
            conditions = MetadataSearchParams(**query, role=role)
            page, total = search_photos(session, map_id, conditions, 10, None)
        assert {photo.id for photo in page} == expected
        assert total == len(expected)


def pages(
    catalog: Catalog, map_id: UUID, limit: int, between: Callable[[], None] = lambda: None
) -> list[Photo]:
    """All photos that the pages show, in their order."""
    seen: list[Photo] = []
    while True:
        after = (seen[-1].uploaded_at, seen[-1].id) if seen else None
        with catalog.read() as session:
            page, _ = search_photos(session, map_id, MetadataSearchParams(), limit, after)
        if not page:
            return seen
        assert len(page) <= limit
        seen += page
        between()


def test_the_cursor_pages_through_everything_exactly_once(catalog: Catalog, map_id: UUID) -> None:
    chance = random.Random(7)
    with catalog.write() as session:
        # Three upload times for 13 photos, in no order: most pages end inside a tie.
        ids = {
            add_photo(
                session,
                map_id,
                uploaded_at=MOMENT + timedelta(microseconds=chance.randrange(3)),
            ).id
            for _ in range(13)
        }
    for limit in (1, 4, 100):
        seen = pages(catalog, map_id, limit)
        assert len(seen) == 13
        assert {photo.id for photo in seen} == ids
        order = [(photo.uploaded_at, photo.id) for photo in seen]
        assert order == sorted(order, reverse=True)


def test_a_photo_inserted_between_two_pages_shifts_no_other(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        ids = [add_photo(session, map_id, uploaded_at=MOMENT).id for _ in range(6)]

    def arrive() -> None:
        with catalog.write() as session:
            add_photo(session, map_id)  # newer than all

    seen = pages(catalog, map_id, 2, arrive)
    assert sorted(photo.id for photo in seen) == sorted(ids)


def test_a_missing_json_value_is_null_for_the_database(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        add_job(session, map_id, error=None)
        add_job(session, map_id, error={})
        assert session.scalar(text("SELECT count(*) FROM jobs WHERE error IS NULL")) == 1
