"""The contract of every `SearchBackend`: exact, current, and gaps are named."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from shared.catalog.database.session import Catalog
from shared.catalog.photos import PhotoRole
from shared.errors import Gone, Unavailable
from shared.ids import new_id
from shared.search_api.photo_filter import Box, Circle
from shared.search_api.protocol import SearchBackend, SearchResponse
from shared.storage import FolderStore
from tests.support.small_map import (
    DIMENSION,
    HOUR,
    NOON,
    Rows,
    SmallMap,
    assert_answers,
    damaged,
    unit_rows,
)
from tests.support.threads import meanwhile

OpenPort = Callable[..., SearchBackend]
# How rows are scanned has nothing to do with the catalog.
whatever_the_catalog = pytest.mark.databases("sqlite")


class AnswersContract:
    """What depends on how rows are compared. A subclass's fixture `port` opens one on `places`."""

    @pytest.fixture
    def places(self, catalog: Catalog, store: FolderStore) -> SmallMap:
        return SmallMap(catalog, store)

    certificate = "exhaustive"
    """How the answers are reached."""
    holds_rows = True
    """Whether the worker itself holds the rows, and compares them."""
    length_error = 1e-6
    """Of the stored rows, which are unit vectors before they are rounded."""

    def test_order_and_scores_equal_brute_force(self, places: SmallMap, port: OpenPort) -> None:
        for seed, count in enumerate((1, 30, 7)):
            places.add(unit_rows(seed, count), dead=seed)
        search = port()
        for seed in range(5):
            vector = unit_rows(100 + seed, 1)[0]
            for k in (1, 10, 100):
                response = search.search(places.request(places.query(vector), k=k))
                assert_answers(response, places.brute_force(vector, k))
        assert response.snapshot_version == places.version
        assert response.missing == ()
        assert response.certificate == self.certificate
        assert response.rows_scanned == 35  # dead rows are not compared

    def test_equal_scores_come_in_the_order_of_the_photos(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        same = np.repeat(unit_rows(1, 1), 4, axis=0)
        for _ in range(3):
            places.add(same)
        response = port().search(places.request(places.query(same[0]), k=7))
        assert [hit.photo_id for hit in response.hits] == sorted(places.rows)[:7]

    def test_stored_photo_is_a_query_without_finding_itself(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        photo_ids = places.add(unit_rows(1, 9))
        request = places.request(places.reference(photo_ids[4]), k=9, exclude=(photo_ids[4],))
        response = port().search(request)
        expected = places.brute_force(places.rows[photo_ids[4]], 9)
        assert expected[0][0] == photo_ids[4]
        assert_answers(response, expected[1:])

    def test_filtered_hits_are_the_best_of_what_passes(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        """For filters that let most, half, few and one of the photos pass."""

        def about(row: int) -> dict[str, Any]:
            return {
                "latitude": 45 + row / 1000,
                "longitude": 7.0,
                "captured_at": NOON + row * HOUR,
                "place": f"room {row % 2}",
                "tags": ["all", *(["rare"] if row % 20 == 3 else [])],
            }

        photo_ids = places.add(unit_rows(1, 40), about=about)
        more = places.add(unit_rows(2, 40), dead=2, about=lambda row: about(row + 40))
        photo_ids += more
        unknown = places.add(unit_rows(3, 10))
        search = port()
        for filters, rows in (
            ({}, range(80)),
            ({"tags": ("all",)}, range(80)),
            ({"place": "room 1"}, range(1, 80, 2)),
            ({"tags": ("rare", "all")}, range(3, 80, 20)),
            (
                {"captured_after": NOON + 11 * HOUR, "captured_before": NOON + 50 * HOUR},
                range(11, 51),
            ),
            ({"near": Circle(latitude=45.02, longitude=7, radius_m=1120)}, range(10, 31)),
            ({"box": Box(south=45.0395, west=7, north=45.0445, east=8)}, range(42, 45)),
            ({"ids": (photo_ids[5], photo_ids[60], new_id())}, (5, 60)),
            ({"place": "room 1", "ids": (photo_ids[4],)}, ()),
            ({"ids": ()}, ()),
        ):
            passing = {photo_ids[row] for row in rows} - set(more[:2])
            if not filters:
                passing |= set(unknown)
            for k in (1, 7, 200):
                vector = unit_rows(100 + k, 1)[0]
                response = search.search(places.request(places.query(vector), k=k, **filters))
                assert_answers(response, places.brute_force(vector, k, passing))
                if self.holds_rows:
                    assert response.rows_scanned == len(passing)
                certificate = self.certificate if passing else "exhaustive"
                assert response.certificate == certificate

    def test_a_filter_that_lets_one_of_thousands_pass_finds_it(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        """Also where the photo is the least similar of all."""
        rows = unit_rows(1, 1200)
        places.add(rows[:600], about=lambda row: {"tags": ["common"]})
        photo_ids = places.add(rows[600:], about=lambda row: {"tags": ["common"]})
        vector = -places.rows[photo_ids[77]]
        places.patch(photo_ids[77], tags=["needle", "common"], latitude=89.9, longitude=180.0)
        search = port()
        for filters in (
            {"tags": ("needle",)},
            {"near": Circle(latitude=90, longitude=0, radius_m=20_000)},
            {"ids": (photo_ids[77],)},
        ):
            response = search.search(places.request(places.query(vector), k=10, **filters))
            assert_answers(response, places.brute_force(vector, 10, {photo_ids[77]}))
            assert response.hits[0].score == pytest.approx(-1, abs=self.length_error)
        assert not search.search(places.request(places.query(vector), tags=("Needle",))).hits

    def test_what_is_changed_of_a_photo_is_seen_by_the_next_call_without_reading_its_chunk(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        first, second = places.add(unit_rows(1, 5)), places.add(unit_rows(2, 5))
        vector = unit_rows(3, 1)[0]
        reference = places.query(vector)
        search = port()
        search.search(places.request(reference))
        for key in places.chunk_keys() if self.holds_rows else ():
            places.store.delete(key)

        def found(**filters: Any) -> set[UUID]:
            response = search.search(places.request(reference, k=20, **filters))
            assert response.missing == ()
            return {hit.photo_id for hit in response.hits}

        nowhere = {"latitude": None, "longitude": None}
        here = {"latitude": 1.0, "longitude": 2.0}
        for columns, cleared, filters in (
            ({"place": "hall"}, {"place": None}, {"place": "hall"}),
            ({"tags": ["night", "wet"]}, {"tags": ["night"]}, {"tags": ("wet",)}),
            ({"captured_at": NOON}, {"captured_at": None}, {"captured_before": NOON}),
            (here, nowhere, {"near": Circle(latitude=1, longitude=2, radius_m=1)}),
        ):
            assert found(**filters) == set()
            places.patch(first[1], **columns)
            places.patch(second[2], **columns)
            assert found(**filters) == {first[1], second[2]}
            places.patch(first[1], **cleared)
            assert found(**filters) == {second[2]}
        assert found() == {*first, *second}

    def test_labelled_queries_are_never_returned_and_can_be_searched_with(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        photo_ids = places.add(unit_rows(1, 12))
        asking = places.add(
            places.rows[photo_ids[3]][np.newaxis], about=lambda row: {"role": PhotoRole.QUERY}
        )[0]
        vector = places.rows.pop(asking)
        search = port()

        def check() -> None:
            for ids in (None, (asking, *photo_ids)):
                request = places.request(places.reference(asking), k=30, ids=ids)
                assert_answers(search.search(request), places.brute_force(vector, 30))
            assert search.status().rows == len(places.rows)

        check()
        assert places.merge(), "a merged chunk holds the queries as well"
        check()
        hidden = places.rows.pop(photo_ids[3])
        places.patch(photo_ids[3], role=PhotoRole.QUERY)
        check()
        places.patch(photo_ids[3], role=PhotoRole.DATABASE)
        places.rows[photo_ids[3]] = hidden
        check()

    def test_photo_that_was_just_published_is_found_in_the_same_call(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        places.add(unit_rows(1, 3))
        search = port()
        vector = unit_rows(2, 1)
        search.search(places.request(places.query(vector[0])))
        for _ in range(3):
            (fresh,) = places.add(vector)
            response = search.search(places.request(places.query(vector[0]), k=20))
            assert fresh in {hit.photo_id for hit in response.hits}
            assert response.snapshot_version == places.version

    def test_deleted_photo_is_left_out_of_the_next_search(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        photo_ids = places.add(unit_rows(1, 6)) + places.add(unit_rows(2, 6))
        vector = places.rows[photo_ids[3]]
        reference = places.query(vector)
        places.delete(photo_ids[0])  # before anything was loaded
        search = port()
        response = search.search(places.request(reference, k=20))
        assert response.hits[0].photo_id == photo_ids[3]
        assert_answers(response, places.brute_force(vector, 20))
        for gone in (photo_ids[3], photo_ids[9]):
            places.delete(gone)
            response = search.search(places.request(reference, k=20))
            assert_answers(response, places.brute_force(vector, 20))

    def test_search_returns_photos_of_its_own_map_only(
        self, places: SmallMap, port: OpenPort, catalog: Catalog, store: FolderStore
    ) -> None:
        other = SmallMap(catalog, store)
        places.add(unit_rows(1, 5))
        other.add(unit_rows(1, 5))
        search = port()
        for one in (places, other):
            response = search.search(one.request(one.query(unit_rows(1, 1)[0]), k=20))
            assert {hit.photo_id for hit in response.hits} == set(one.rows)

    def test_queries_from_many_threads_are_exact_while_photos_come_and_go(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        """What a query may see is a whole version: every photo with its own score."""
        seen: dict[UUID, Rows] = {}
        rows = unit_rows(0, 20).astype(places.row_type)
        seen |= dict(zip(places.add(rows), rows, strict=True))
        vector = unit_rows(99, 1)[0]
        reference = places.query(vector)
        search = port()
        responses: list[SearchResponse] = []
        with meanwhile(
            lambda: responses.append(search.search(places.request(reference, k=500))), threads=3
        ):
            for seed in range(1, 6):
                rows = unit_rows(seed, 4).astype(places.row_type)
                photo_ids = places.add(rows)
                seen |= dict(zip(photo_ids, rows, strict=True))
                places.delete(photo_ids[1])
                places.merge()
        exact = vector.astype(np.float64) / np.linalg.norm(vector.astype(np.float64))
        for response in responses:
            for hit in response.hits:
                assert hit.score == pytest.approx(float(seen[hit.photo_id] @ exact), abs=1e-6)
        final = search.search(places.request(reference, k=500))
        assert_answers(final, places.brute_force(vector, 500))


class SearchPortContract(AnswersContract):
    """Every promise of the port, which may take the time to wait: `port(max_wait_seconds=0.05)`."""

    def test_search_in_a_map_without_photos_has_no_hits(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        response = port().search(places.request(places.query(unit_rows(1, 1)[0])))
        assert (response.hits, response.missing) == ((), ())

    def test_search_raises_search_behind_if_min_version_is_not_reached(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        places.add(unit_rows(1, 3))
        reference = places.query(unit_rows(2, 1)[0])
        search = port(max_wait_seconds=0.05)
        with pytest.raises(Unavailable) as caught:
            search.search(places.request(reference, min_version=places.version + 1))
        assert caught.value.code == "search_behind"
        assert search.search(places.request(reference)).hits, "others are served as before"

    def test_search_waits_for_min_version(self, places: SmallMap, port: OpenPort) -> None:
        places.add(unit_rows(1, 3))
        vector = unit_rows(2, 1)
        request = places.request(places.query(vector[0]), min_version=places.version + 1)
        search = port(max_wait_seconds=30)
        search.search(places.request((request.object_key, 0)))
        publisher = threading.Timer(0.05, places.add, [vector])
        publisher.start()
        response = search.search(request)
        publisher.join()
        assert response.hits[0].score == pytest.approx(1.0, abs=self.length_error)
        assert response.snapshot_version == request.min_version

    @pytest.mark.parametrize("damage", ["flipped", "truncated", "gone"])
    def test_chunk_that_cannot_be_read_is_named_and_the_rest_served(
        self, places: SmallMap, port: OpenPort, damage: str
    ) -> None:
        places.add(unit_rows(1, 5))
        broken = places.add(unit_rows(2, 5))
        places.add(unit_rows(3, 5))
        key, _ = places.reference(broken[0])
        whole = places.store.get(key)
        if damage == "gone":
            places.store.delete(key)
        else:
            places.store.put(key, damaged(whole, damage))
        for photo_id in broken:
            del places.rows[photo_id]
        vector = unit_rows(4, 1)[0]
        search = port()
        response = search.search(places.request(places.query(vector), k=20))
        assert response.missing == (key,)
        assert response.certificate == "none"
        assert_answers(response, places.brute_force(vector, 20))
        assert search.status().missing == (key,)

    @pytest.mark.parametrize("damage", ["flipped", "truncated"])
    def test_search_with_a_damaged_descriptor_is_refused(
        self, places: SmallMap, port: OpenPort, damage: str
    ) -> None:
        photo_ids = places.add(unit_rows(1, 5))
        reference = places.reference(photo_ids[2])
        places.store.put(reference[0], damaged(places.store.get(reference[0]), damage))
        with pytest.raises(Unavailable) as caught:
            port().search(places.request(reference))
        assert caught.value.code == "chunk_unreadable"

    def test_search_with_a_deleted_descriptor_raises_gone(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        places.add(unit_rows(1, 3))
        reference = places.query(unit_rows(2, 1)[0])
        search = port()
        search.search(places.request(reference))
        places.store.delete(reference[0])
        for unknown in (reference, ("chunks/no/such.npy", 0)):
            with pytest.raises(Gone) as caught:
                search.search(places.request(unknown))
            assert caught.value.code == "query_expired"

    def test_reference_into_a_superseded_chunk_still_answers(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        photo_ids = places.add(unit_rows(1, 4)) + places.add(unit_rows(2, 4))
        old = places.reference(photo_ids[6])
        search = port()
        before = search.search(places.request(old, k=20))
        assert places.merge()
        assert old[0] not in places.chunk_keys()
        after = search.search(places.request(old, k=20))
        assert after.hits == before.hits
        assert after.snapshot_version == before.snapshot_version + 1

    def test_status_has_rows_versions_and_memory(self, places: SmallMap, port: OpenPort) -> None:
        photo_ids = places.add(unit_rows(1, 5), dead=1)
        places.delete(photo_ids[2])
        search = port()
        search.search(places.request(places.query(unit_rows(2, 1)[0])))
        status = search.status()
        assert status.rows == 3
        assert status.versions == {places.generation_id: places.version}
        assert (
            not self.holds_rows
            or status.resident_bytes >= 5 * DIMENSION * np.dtype(places.row_type).itemsize
        )
        assert status.missing == ()
