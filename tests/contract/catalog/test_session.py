"""Times, transactions and constraints of the catalog, on SQLite and on PostgreSQL."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone
from uuid import UUID

import pytest
from sqlalchemy import Select, select
from sqlalchemy.exc import DBAPIError, IntegrityError, StatementError

from shared.catalog.database.base import db_now, db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation, GenerationState, active_generation
from shared.catalog.maps import Map, increment_map_version
from shared.catalog.photos import Photo, count_live_photos
from shared.ids import new_id
from tests.support.catalog_rows import add_generation, add_map, add_photo

MOMENT = datetime(2024, 5, 6, 7, 8, 9, 123456, tzinfo=UTC)


def test_times_come_back_aware_in_utc_and_exact(catalog: Catalog, map_id: UUID) -> None:
    far_east = MOMENT.astimezone(timezone(timedelta(hours=9, minutes=30)))
    with catalog.write() as session:
        photo_id = add_photo(session, map_id, captured_at=far_east).id
    with catalog.read() as session:
        photo = session.get_one(Photo, photo_id)
    assert photo.captured_at == MOMENT
    assert photo.captured_at is not None
    assert photo.captured_at.tzinfo is UTC
    assert photo.uploaded_at.utcoffset() == timedelta(0)


def test_a_time_without_an_offset_is_refused(catalog: Catalog, map_id: UUID) -> None:
    naive = MOMENT.replace(tzinfo=None)
    with pytest.raises(StatementError, match="without an offset"), catalog.write() as session:
        add_photo(session, map_id, captured_at=naive)
    with catalog.read() as session:
        assert count_live_photos(session, map_id) == 0


def test_the_databases_clock_is_in_utc_can_be_added_to_and_compares_with_stored_times(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        past = add_photo(session, map_id, captured_at=datetime.now(UTC) - timedelta(hours=1)).id
        add_photo(session, map_id, captured_at=datetime.now(UTC) + timedelta(hours=1))
    with catalog.read() as session:
        now, later, earlier = session.execute(
            select(db_now(), db_now_plus(90.5), db_now_plus(-3600))
        ).one()
        before_now = session.scalars(select(Photo.id).where(Photo.captured_at < db_now())).all()
    assert abs(now - datetime.now(UTC)) < timedelta(minutes=1)  # both on this machine
    assert timedelta(seconds=89) < later - now < timedelta(seconds=92)
    assert timedelta(seconds=3598) < now - earlier < timedelta(seconds=3601)
    assert before_now == [past]


def test_write_rolls_back_when_its_block_raises(catalog: Catalog, map_id: UUID) -> None:
    def half_way() -> None:
        with catalog.write() as session:
            add_photo(session, map_id)
            increment_map_version(session, map_id)
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        half_way()
    with catalog.read() as session:
        assert count_live_photos(session, map_id) == 0
        assert session.get_one(Map, map_id).version == 0
    with catalog.write() as session:  # and the next one is not harmed
        add_photo(session, map_id)
    with catalog.read() as session:
        assert count_live_photos(session, map_id) == 1


def test_a_read_session_refuses_writes(catalog: Catalog, map_id: UUID) -> None:
    with pytest.raises(DBAPIError, match=r"read-?only"), catalog.read() as session:
        add_photo(session, map_id)
    with catalog.read() as session:
        assert count_live_photos(session, map_id) == 0
    with catalog.write() as session:
        add_photo(session, map_id)  # the pooled connection may write again


def test_read_sees_one_snapshot_while_others_write(catalog: Catalog, map_id: UUID) -> None:
    with catalog.read() as session:
        before = count_live_photos(session, map_id), session.scalar(select(Map.version))
        with catalog.write() as writing:
            add_photo(writing, map_id)
            increment_map_version(writing, map_id)
        session.expire_all()
        after = count_live_photos(session, map_id), session.scalar(select(Map.version))
    assert before == after == (0, 0)
    with catalog.read() as session:
        assert (count_live_photos(session, map_id), session.scalar(select(Map.version))) == (1, 1)


def test_coordinates_come_in_pairs_or_not_at_all(catalog: Catalog, map_id: UUID) -> None:
    for half in ({"latitude": 1.0}, {"longitude": 1.0}):
        with pytest.raises(IntegrityError), catalog.write() as session:
            add_photo(session, map_id, **half)
    with catalog.write() as session:
        both = add_photo(session, map_id, latitude=-12.5, longitude=179.999999).id
        add_photo(session, map_id)
    with catalog.read() as session:
        photo = session.get_one(Photo, both)
        assert (photo.latitude, photo.longitude) == (-12.5, 179.999999)


def test_two_maps_of_one_name_and_a_photo_of_no_map_are_refused(
    catalog: Catalog, map_id: UUID
) -> None:
    with pytest.raises(IntegrityError), catalog.write() as session:
        add_map(session)
    with pytest.raises(IntegrityError), catalog.write() as session:
        add_photo(session, new_id())


def generations_of(map_id: UUID, state: GenerationState) -> Select[Generation]:
    return select(Generation).where(Generation.map_id == map_id, Generation.state == state)


@pytest.mark.parametrize("state", [GenerationState.ACTIVE, GenerationState.BUILDING])
def test_a_map_has_at_most_one_active_and_one_building_generation_and_any_number_of_ended_ones(
    catalog: Catalog, map_id: UUID, state: GenerationState
) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
        first = add_generation(session, map_id, state).id
        add_generation(session, other, state)
    with pytest.raises(IntegrityError), catalog.write() as session:
        add_generation(session, map_id, state)
    with catalog.write() as session:
        session.get_one(Generation, first).state = GenerationState.RETIRED
        for ended in (GenerationState.RETIRED, GenerationState.ABANDONED) * 2:
            add_generation(session, map_id, ended)
        session.flush()
        assert active_generation(session, map_id) is None
        second = add_generation(session, map_id, state).id
    with catalog.read() as session:
        assert session.scalars(generations_of(map_id, state)).one().id == second
        active = active_generation(session, map_id)
        assert (active.id if active else None) == (
            second if state == GenerationState.ACTIVE else None
        )
