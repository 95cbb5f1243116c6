"""What the catalog promises, on SQLite and on PostgreSQL alike."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta, timezone
from typing import Any
from uuid import UUID

import pytest
from hypothesis import given
from hypothesis import strategies as some
from sqlalchemy import select, text
from sqlalchemy.exc import DBAPIError, IntegrityError, StatementError

from shared.catalog.base import db_now, db_now_plus
from shared.catalog.chunks import allocate_slot
from shared.catalog.generations import (
    Generation,
    GenerationState,
    active_generation,
    building_generation,
)
from shared.catalog.maps import (
    DEFAULT_MAP,
    Map,
    get_map,
    get_or_create_default_map,
    increment_map_version,
)
from shared.catalog.models import Model, get_or_create_model
from shared.catalog.photo_search import MetadataFilter, search_photos
from shared.catalog.photos import (
    Photo,
    count_live_photos,
    find_photo_by_sha256,
    get_live_photos,
    get_photo,
    list_photos_changed_since,
)
from shared.catalog.session import Catalog
from shared.errors import NotFound
from shared.ids import new_id
from shared.search_api.photo_filter import PhotoFilter
from tests.support.catalog_rows import add_generation, add_job, add_map, add_photo, delete

MOMENT = datetime(2024, 5, 6, 7, 8, 9, 123456, tzinfo=UTC)


@pytest.fixture
def map_id(catalog: Catalog) -> UUID:
    with catalog.write() as session:
        return add_map(session).id


# --- times -----------------------------------------------------------------------------------


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


def test_the_databases_clock_is_in_utc_and_can_be_added_to(catalog: Catalog) -> None:
    with catalog.read() as session:
        now, later, earlier = session.execute(
            select(db_now(), db_now_plus(90.5), db_now_plus(-3600))
        ).one()
    assert abs(now - datetime.now(UTC)) < timedelta(minutes=1)  # both on this machine
    assert timedelta(seconds=89) < later - now < timedelta(seconds=92)
    assert timedelta(seconds=3598) < now - earlier < timedelta(seconds=3601)


def test_the_databases_clock_compares_with_stored_times(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        past = add_photo(session, map_id, captured_at=datetime.now(UTC) - timedelta(hours=1)).id
        add_photo(session, map_id, captured_at=datetime.now(UTC) + timedelta(hours=1))
    with catalog.read() as session:
        before_now = session.scalars(select(Photo.id).where(Photo.captured_at < db_now())).all()
    assert before_now == [past]


# --- transactions ----------------------------------------------------------------------------


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


def test_what_write_gave_stays_readable_after_the_block(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        photo = add_photo(session, map_id, tags=["night"])
    assert photo.tags == ["night"]
    assert photo.filename


def test_read_never_writes(catalog: Catalog, map_id: UUID) -> None:
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


def test_an_unfinished_write_is_seen_by_no_one(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as writing:
        add_photo(writing, map_id)
        with catalog.read() as session:
            assert count_live_photos(session, map_id) == 0


# --- constraints -----------------------------------------------------------------------------


def test_the_same_live_bytes_twice_in_a_map_are_refused_by_the_database(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        first = add_photo(session, map_id, sha256="a" * 64).id
    with pytest.raises(IntegrityError), catalog.write() as session:
        add_photo(session, map_id, sha256="a" * 64)
    with catalog.read() as session:
        found = find_photo_by_sha256(session, map_id, "a" * 64)
        assert found is not None
        assert found.id == first


def test_the_same_bytes_are_allowed_again_after_deletion_and_in_another_map(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
        add_photo(session, other, sha256="a" * 64)
        first = add_photo(session, map_id, sha256="a" * 64).id
    for _ in range(2):  # deleted ones may lie there in any number
        delete(catalog, map_id, first)
        with catalog.write() as session:
            first = add_photo(session, map_id, sha256="a" * 64).id
    with catalog.read() as session:
        found = find_photo_by_sha256(session, map_id, "a" * 64)
        assert found is not None
        assert found.id == first


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


def test_two_maps_of_one_name_are_refused(catalog: Catalog, map_id: UUID) -> None:
    with pytest.raises(IntegrityError), catalog.write() as session:
        add_map(session)


def test_a_photo_of_no_map_is_refused(catalog: Catalog) -> None:
    with pytest.raises(IntegrityError), catalog.write() as session:
        add_photo(session, new_id())


@pytest.mark.parametrize("state", [GenerationState.ACTIVE, GenerationState.BUILDING])
def test_a_map_has_at_most_one_active_and_one_building_generation(
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
        session.flush()
        second = add_generation(session, map_id, state).id
    find = active_generation if state == GenerationState.ACTIVE else building_generation
    with catalog.read() as session:
        found = find(session, map_id)
        assert found is not None
        assert found.id == second


def test_ended_generations_may_be_many(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        for state in (GenerationState.RETIRED, GenerationState.ABANDONED) * 2:
            add_generation(session, map_id, state)
    with catalog.read() as session:
        assert active_generation(session, map_id) is None
        assert building_generation(session, map_id) is None


# --- maps and versions -----------------------------------------------------------------------


def test_versions_are_strictly_increasing_under_concurrent_bumps(
    catalog: Catalog, map_id: UUID
) -> None:
    threads, each = 6, 12

    def bump() -> list[int]:
        seen = []
        for _ in range(each):
            with catalog.write() as session:
                seen.append(increment_map_version(session, map_id))
        return seen

    with ThreadPoolExecutor(threads) as pool:
        by_thread = [future.result() for future in [pool.submit(bump) for _ in range(threads)]]
    assert all(seen == sorted(seen) for seen in by_thread)
    assert sorted(version for seen in by_thread for version in seen) == list(
        range(1, threads * each + 1)
    )
    with catalog.read() as session:
        assert session.get_one(Map, map_id).version == threads * each


def test_a_rolled_back_bump_leaves_no_gap(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        assert increment_map_version(session, map_id) == 1
        session.rollback()
    with catalog.write() as session:
        assert increment_map_version(session, map_id) == 1


def test_the_default_map_is_made_once_by_many_at_once(catalog: Catalog) -> None:
    together = threading.Barrier(4)

    def ensure() -> UUID:
        together.wait()
        with catalog.write() as session:
            return get_or_create_default_map(session, "test-tiny-avg").id

    with ThreadPoolExecutor(4) as pool:
        found = {future.result() for future in [pool.submit(ensure) for _ in range(4)]}
    assert len(found) == 1
    with catalog.read() as session:
        assert {get_map(session, DEFAULT_MAP).id} == found


def test_a_model_is_registered_once_by_many_at_once(catalog: Catalog) -> None:
    together = threading.Barrier(4)

    def ensure() -> UUID:
        together.wait()
        with catalog.write() as session:
            return get_or_create_model(session, "net", "f" * 64, "MIT", {"made": "here"}).id

    with ThreadPoolExecutor(4) as pool:
        found = {future.result() for future in [pool.submit(ensure) for _ in range(4)]}
    with catalog.read() as session:
        assert set(session.scalars(select(Model.id))) == found
    assert len(found) == 1


def test_an_unknown_map_is_not_found(catalog: Catalog) -> None:
    with catalog.read() as session, pytest.raises(NotFound, match="nowhere"):
        get_map(session, "nowhere")


# --- deleted photos --------------------------------------------------------------------------


def test_a_deleted_photo_shows_in_no_query(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        stays = add_photo(session, map_id).id
        goes = add_photo(session, map_id, sha256="b" * 64).id
        version = session.get_one(Map, map_id).version
    delete(catalog, map_id, goes)
    with catalog.read() as session:
        with pytest.raises(NotFound):
            get_photo(session, map_id, goes)
        assert list(get_live_photos(session, [stays, goes])) == [stays]
        assert find_photo_by_sha256(session, map_id, "b" * 64) is None
        assert count_live_photos(session, map_id) == 1
        page, total = search_photos(session, map_id, MetadataFilter(), 10, None)
        assert ([photo.id for photo in page], total) == ([stays], 1)
        changed = list_photos_changed_since(session, map_id, version)
        assert [(facts.photo_id, facts.findable) for facts in changed] == [(goes, False)]
        assert list_photos_changed_since(session, map_id, version + 1) == []


def test_a_photo_of_another_map_is_not_found(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        other = add_map(session, "other").id
        photo_id = add_photo(session, other).id
    with catalog.read() as session, pytest.raises(NotFound):
        get_photo(session, map_id, photo_id)


# --- metadata search -------------------------------------------------------------------------


def found(catalog: Catalog, map_id: UUID, **wanted: Any) -> set[str]:
    """The names of all photos that match, with the total checked against them."""
    about = {name: wanted.pop(name) for name in PhotoFilter.model_fields if name in wanted}
    wanted["photos"] = PhotoFilter(**about)
    with catalog.read() as session:
        page, total = search_photos(session, map_id, MetadataFilter(**wanted), 1000, None)
    assert total == len(page)
    return {photo.filename for photo in page}


def test_a_file_name_is_found_by_a_part_of_it_in_any_case(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        for name in ("Market-Street.JPG", "market hall.png", "harbour.jpg"):
            add_photo(session, map_id, filename=name)
    assert found(catalog, map_id, filename="MARKET") == {"Market-Street.JPG", "market hall.png"}
    assert found(catalog, map_id, filename="street.jpg") == {"Market-Street.JPG"}
    assert found(catalog, map_id, filename="square") == set()
    assert found(catalog, map_id) == {"Market-Street.JPG", "market hall.png", "harbour.jpg"}


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


def test_bounds_of_time_are_inclusive(catalog: Catalog, map_id: UUID) -> None:
    step = timedelta(microseconds=1)
    with catalog.write() as session:
        for name, at in (("early", -1), ("exact", 0), ("late", 1)):
            add_photo(session, map_id, filename=name, uploaded_at=MOMENT + at * step)
    assert found(catalog, map_id, upload_after=MOMENT) == {"exact", "late"}
    assert found(catalog, map_id, upload_before=MOMENT) == {"early", "exact"}
    assert found(catalog, map_id, upload_after=MOMENT, upload_before=MOMENT) == {"exact"}
    elsewhere = MOMENT.astimezone(timezone(timedelta(hours=-7)))
    assert found(catalog, map_id, upload_after=elsewhere, upload_before=elsewhere) == {"exact"}


def test_whole_seconds_compare_with_fractions_of_one(catalog: Catalog, map_id: UUID) -> None:
    whole = MOMENT.replace(microsecond=0)
    with catalog.write() as session:
        add_photo(session, map_id, filename="whole", uploaded_at=whole)
        add_photo(session, map_id, filename="after", uploaded_at=MOMENT)
    assert found(catalog, map_id, upload_before=whole) == {"whole"}
    assert found(catalog, map_id, upload_after=whole) == {"whole", "after"}


def test_bounds_of_size_are_inclusive_and_large(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        for size in (0, 999, 1000, 2**40):
            add_photo(session, map_id, filename=str(size), size_bytes=size)
    assert found(catalog, map_id, min_file_size=999) == {"999", "1000", str(2**40)}
    assert found(catalog, map_id, max_file_size=999) == {"0", "999"}
    assert found(catalog, map_id, min_file_size=0, max_file_size=0) == {"0"}
    assert found(catalog, map_id, min_file_size=2**40) == {str(2**40)}


TAGS = ["night", "it's", 'the "old" one', "日本", "naïve", "a\\b", "50%", "🏠", "[1]", "1", "null"]


def test_a_tag_is_matched_exactly(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        for tag in TAGS:
            add_photo(session, map_id, filename=tag, tags=["common", tag])
            add_photo(session, map_id, filename="longer", tags=[f"{tag}x", f"x{tag}"])
        add_photo(session, map_id, filename="none", tags=[])
    for tag in TAGS:
        assert found(catalog, map_id, tags=(tag,)) == {tag}
    assert found(catalog, map_id, tags=("common",)) == set(TAGS)


def test_a_tags_case_matters_and_parts_do_not_match(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        add_photo(session, map_id, tags=["Night", "nightly"])
    assert found(catalog, map_id, tags=("night",)) == set()


def test_all_tags_are_wanted(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        add_photo(session, map_id, filename="both", tags=["wet", "night"])
        add_photo(session, map_id, filename="one", tags=["night"])
    assert found(catalog, map_id, tags=("night", "wet")) == {"both"}
    assert found(catalog, map_id, tags=("night",)) == {"both", "one"}


def test_filters_work_together_and_in_one_map(catalog: Catalog, map_id: UUID) -> None:
    wanted = {"filename": "x.jpg", "tags": ["t"], "size_bytes": 5, "uploaded_at": MOMENT}
    later = MOMENT + timedelta(days=1)
    with catalog.write() as session:
        other = add_map(session, "other").id
        right = add_photo(session, map_id, **wanted).id
        add_photo(session, other, **wanted)
        for wrong in (
            {"filename": "y.jpg"},
            {"tags": ["u"]},
            {"size_bytes": 6},
            {"uploaded_at": later},
        ):
            add_photo(session, map_id, **{**wanted, **wrong})
        conditions = MetadataFilter(
            filename="x", upload_before=MOMENT, max_file_size=5, photos=PhotoFilter(tags=("t",))
        )
        page, total = search_photos(session, map_id, conditions, 10, None)
    assert ([photo.id for photo in page], total) == ([right], 1)


def pages(
    catalog: Catalog, map_id: UUID, limit: int, between: Callable[[], None] = lambda: None
) -> list[Photo]:
    """All photos that the pages show, in their order."""
    seen: list[Photo] = []
    while True:
        after = (seen[-1].uploaded_at, seen[-1].id) if seen else None
        with catalog.read() as session:
            page, _ = search_photos(session, map_id, MetadataFilter(), limit, after)
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


def test_a_photo_that_arrives_while_someone_pages_moves_no_other(
    catalog: Catalog, map_id: UUID
) -> None:
    with catalog.write() as session:
        ids = [add_photo(session, map_id, uploaded_at=MOMENT).id for _ in range(6)]

    def arrive() -> None:
        with catalog.write() as session:
            add_photo(session, map_id)  # newer than all

    seen = pages(catalog, map_id, 2, arrive)
    assert sorted(photo.id for photo in seen) == sorted(ids)


def test_the_total_counts_what_matches_and_not_the_page(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        for number in range(7):
            add_photo(session, map_id, tags=["odd"] if number % 2 else [], uploaded_at=MOMENT)
    with catalog.read() as session:
        first, total = search_photos(
            session, map_id, MetadataFilter(photos=PhotoFilter(tags=("odd",))), 2, None
        )
        assert (len(first), total) == (2, 3)
        after = (first[-1].uploaded_at, first[-1].id)
        rest, total = search_photos(
            session, map_id, MetadataFilter(photos=PhotoFilter(tags=("odd",))), 2, after
        )
        assert (len(rest), total) == (1, 3)


def test_metadata_comes_back_as_it_was(catalog: Catalog, map_id: UUID) -> None:
    said = {"camera": "x'y", "nested": {"list": [1, 2.5, None, True, "日本"]}, "empty": {}}
    with catalog.write() as session:
        photo_id = add_photo(session, map_id, attributes=said, tags=TAGS).id
    with catalog.read() as session:
        photo = session.get_one(Photo, photo_id)
        assert photo.attributes == said
        assert photo.tags == TAGS


def test_a_missing_json_value_is_null_for_the_database(catalog: Catalog, map_id: UUID) -> None:
    with catalog.write() as session:
        add_job(session, map_id, error=None)
        add_job(session, map_id, error={})
        assert session.scalar(text("SELECT count(*) FROM jobs WHERE error IS NULL")) == 1


# --- slots -----------------------------------------------------------------------------------


@given(data=some.data(), slot_rows=some.integers(2, 60))
def test_take_slot_never_lets_a_slot_exceed_its_rows(data: some.DataObject, slot_rows: int) -> None:
    batches = data.draw(some.lists(some.integers(1, slot_rows), max_size=40))
    generation = Generation(open_slot=0, open_slot_rows=0)
    held: dict[int, int] = {}
    slots = []
    for rows in batches:
        slot = allocate_slot(generation, rows, slot_rows)
        held[slot] = held.get(slot, 0) + rows
        slots.append(slot)
    assert all(rows <= slot_rows for rows in held.values())
    assert slots == sorted(slots)  # a slot that was left is never opened again
    assert sorted(held) == list(range(len(held)))
    if held:
        assert generation.open_slot_rows == held[generation.open_slot]
