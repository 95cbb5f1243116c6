"""What every search tier promises (`shared.search_api.protocol`): exact, current, honest about
gaps."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, BinaryIO
from uuid import UUID

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume
from hypothesis import settings as how
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)
from numpy.typing import NDArray

from services.search import executor, gpu
from services.search import worker as worker_module
from services.search.chunk_loader import ChunkLoader, StoredChunk
from services.search.metrics import MeteredSearch
from services.search.worker import SearchWorker
from services.steward.tasks.compaction import merge_slot
from shared.catalog.chunks import Chunk, Descriptor, list_live_chunks
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.maps import Map, increment_map_version, lock_map
from shared.catalog.models import get_or_create_model
from shared.catalog.photos import Photo, PhotoRole, mark_photo_deleted
from shared.catalog.schema import migrate
from shared.catalog.session import Catalog
from shared.codes.int8_codes import Int8Codes
from shared.config.settings import Settings
from shared.config.shards import SINGLE_SHARD
from shared.errors import Gone, InvalidRequest, Unavailable
from shared.ids import new_id
from shared.search_api.photo_filter import Box, Circle, PhotoFilter
from shared.search_api.protocol import Mode, SearchBackend, SearchRequest, SearchResponse
from shared.storage import FolderStore, ObjectStore, read_retries
from shared.storage.chunks import decode_rows, encode_rows, manifest_key, write_chunk
from tests.support.codes import always_by_codes, always_by_int8, int8_on_demand
from tests.support.search_tier import SearchTier

DIMENSION = 12
NOON = datetime(2024, 5, 6, 12, tzinfo=UTC)
HOUR = timedelta(hours=1)
Rows = NDArray[np.float32]
Reference = tuple[str, int]
"""A descriptor: object key and row."""


def unit_rows(seed: int, count: int, dimension: int = DIMENSION) -> Rows:
    rows = np.random.default_rng(seed).standard_normal((count, dimension))
    found: Rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return found


class SmallMap:
    """A map with one generation, changed as the extractor, the gateway and the steward do.

    `rows` is the model to compare with: every live photo with its descriptor.
    """

    mode = Mode.AUTO
    """How it is searched."""

    def __init__(self, catalog: Catalog, store: ObjectStore) -> None:
        self.catalog = catalog
        self.store = store
        self.map_id, self.generation_id = new_id(), new_id()
        self.rows: dict[UUID, Rows] = {}
        with catalog.write() as session:
            session.add(Map(id=self.map_id, name=f"map-{self.map_id}", extractor="test"))
            session.flush()
            model = get_or_create_model(session, "test", "0" * 64, "MIT", {})
            session.add(
                Generation(
                    id=self.generation_id,
                    map_id=self.map_id,
                    state=GenerationState.ACTIVE,
                    extractor="test",
                    spec={"extractor": "test"},
                    spec_fingerprint="0" * 64,
                    dimension=DIMENSION,
                    model_id=model.id,
                )
            )

    @property
    def version(self) -> int:
        with self.catalog.read() as session:
            return session.get_one(Map, self.map_id).version

    def add(
        self,
        rows: Rows,
        slot: int = 0,
        dead: int = 0,
        about: Callable[[int], dict[str, Any]] = lambda row: {},
    ) -> list[UUID]:
        """Publish a chunk of photos; its first `dead` rows belong to none (a lease was lost).

        `about` says what is known of the photo of a row: columns of `Photo`.
        """
        chunk_id, photo_ids = new_id(), [new_id() for _ in rows]
        written = write_chunk(
            self.store,
            generation_id=self.generation_id,
            chunk_id=chunk_id,
            rows=rows,
            photo_ids=photo_ids,
            spec={"extractor": "test"},
        )
        with self.catalog.write() as session:
            lock_map(session, self.map_id)
            session.add_all(
                self._photo(photo_id, **about(row)) for row, photo_id in enumerate(photo_ids)
            )
            session.add(
                Chunk(
                    id=chunk_id,
                    generation_id=self.generation_id,
                    slot=slot,
                    object_key=written.object_key,
                    rows=written.rows,
                    size_bytes=written.size_bytes,
                    sha256=written.sha256,
                )
            )
            session.flush()
            session.add_all(
                Descriptor(
                    generation_id=self.generation_id, photo_id=photo_id, chunk_id=chunk_id, row=row
                )
                for row, photo_id in enumerate(photo_ids)
                if row >= dead
            )
            increment_map_version(session, self.map_id)
        self.rows |= dict(list(zip(photo_ids, rows, strict=True))[dead:])
        return photo_ids

    def _photo(self, photo_id: UUID, **columns: Any) -> Photo:
        return Photo(
            id=photo_id,
            map_id=self.map_id,
            sha256=photo_id.hex * 2,
            object_key=f"originals/{photo_id}",
            filename="photo.jpg",
            media_type="image/jpeg",
            size_bytes=1,
            width=1,
            height=1,
            **columns,
        )

    def patch(self, photo_id: UUID, **columns: Any) -> None:
        """As `PATCH /uploads/{file_id}` does it."""
        with self.catalog.write() as session:
            lock_map(session, self.map_id)
            photo = session.get_one(Photo, photo_id)
            for name, value in columns.items():
                setattr(photo, name, value)
            photo.changed_version = increment_map_version(session, self.map_id)

    def delete(self, photo_id: UUID) -> None:
        with self.catalog.write() as session:
            lock_map(session, self.map_id)
            photo = session.get_one(Photo, photo_id)
            mark_photo_deleted(session, photo, increment_map_version(session, self.map_id))
        del self.rows[photo_id]

    def merge(self, slot: int = 0) -> bool:
        return merge_slot(self.catalog, self.store, self.generation_id, slot)

    def chunk_keys(self) -> list[str]:
        with self.catalog.read() as session:
            return [chunk.object_key for chunk in list_live_chunks(session, self.generation_id)]

    def reference(self, photo_id: UUID) -> Reference:
        with self.catalog.read() as session:
            descriptor = session.get_one(Descriptor, (self.generation_id, photo_id))
            return session.get_one(Chunk, descriptor.chunk_id).object_key, descriptor.row

    def query(self, vector: Rows) -> Reference:
        """Store a query's descriptor, as a `describe` job does."""
        key = f"queries/{new_id()}.npy"
        self.store.put(key, encode_rows(vector[np.newaxis]))
        return key, 0

    def request(
        self,
        reference: Reference,
        k: int = 10,
        min_version: int | None = None,
        min_score: float | None = None,
        exclude: tuple[UUID, ...] = (),
        **photos: Any,
    ) -> SearchRequest:
        """`photos` are the filter's conditions."""
        return SearchRequest(
            map_id=self.map_id,
            generation_id=self.generation_id,
            object_key=reference[0],
            row=reference[1],
            min_version=self.version if min_version is None else min_version,
            k=k,
            photos=PhotoFilter(**photos),
            min_score=min_score,
            exclude=exclude,
            mode=self.mode,
        )

    def brute_force(
        self, vector: Rows, k: int = 10, among: Collection[UUID] | None = None
    ) -> list[tuple[UUID, float]]:
        exact = vector.astype(np.float64)
        exact /= np.linalg.norm(exact)
        scored = [(-float(row.astype(np.float64) @ exact), p) for p, row in self.rows.items()]
        if among is not None:
            scored = [(score, photo_id) for score, photo_id in scored if photo_id in among]
        return [(photo_id, -score) for score, photo_id in sorted(scored)[:k]]


def assert_answers(response: SearchResponse, expected: list[tuple[UUID, float]]) -> None:
    assert [hit.photo_id for hit in response.hits] == [photo_id for photo_id, _ in expected]
    np.testing.assert_allclose(
        [hit.score for hit in response.hits], [score for _, score in expected], atol=1e-12
    )


OpenPort = Callable[..., SearchBackend]

# How rows are scanned has nothing to do with the catalog.
whatever_the_catalog = pytest.mark.parametrize("catalog", ["sqlite"], indirect=True)


class SearchPortContract:
    """Every promise of the port. A subclass's fixture `port` opens one on the map `places`.

    It takes settings by name, for example `port(search_wait_seconds=0.05)`.
    """

    @pytest.fixture
    def places(self, catalog: Catalog, store: FolderStore) -> SmallMap:
        return SmallMap(catalog, store)

    certificate = "exhaustive"
    """How the answers are reached."""

    def test_order_and_scores_equal_brute_force(self, places: SmallMap, port: OpenPort) -> None:
        for seed, count in enumerate((1, 30, 7)):
            places.add(unit_rows(seed, count), slot=seed // 2, dead=seed)
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

    def test_hits_below_the_least_score_are_left_out(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        places.add(unit_rows(1, 30))
        vector = unit_rows(2, 1)[0]
        expected = places.brute_force(vector, 30)
        bound = (expected[7][1] + expected[8][1]) / 2
        request = places.request(places.query(vector), k=30, min_score=bound)
        assert_answers(port().search(request), expected[:8])

    @pytest.mark.parametrize("k", [1, 5, 30])
    def test_word_weights_rank_and_the_score_stays_the_plain_cosine(
        self, places: SmallMap, port: OpenPort, k: int
    ) -> None:
        """Weights 3, 0, 1, 0.5 of four words of three numbers; also with a least score, which is
        of the plain cosine, and over equal rows."""
        for slot in range(3):
            places.add(np.repeat(unit_rows(slot, 5), 2, axis=0), slot=slot)
        vector, weights = unit_rows(9, 1)[0], (3.0, 0.0, 1.0, 0.5)
        product = vector.astype(np.float64) * np.repeat(weights, 3)
        # A query like any other: float32.
        weighted = (product / np.linalg.norm(product)).astype(np.float32).astype(np.float64)
        weighted /= np.linalg.norm(weighted)
        exact = vector.astype(np.float64) / np.linalg.norm(vector.astype(np.float64))
        by_weight = sorted(
            (
                -float(row.astype(np.float64) @ weighted),
                photo_id,
                float(row.astype(np.float64) @ exact),
            )
            for photo_id, row in places.rows.items()
        )
        assert [hit[1] for hit in by_weight] != [hit[0] for hit in places.brute_force(vector, 30)]
        search = port()
        for least in (None, 0.0):
            request = places.request(places.query(vector), k=k, min_score=least)
            answer = search.search(request.model_copy(update={"word_weights": weights}))
            expected = [hit for hit in by_weight if least is None or hit[2] >= least][:k]
            assert len(answer.hits) == len(expected) > 0
            assert [hit.photo_id for hit in answer.hits] == [hit[1] for hit in expected]
            by = [hit.weighted_score for hit in answer.hits]
            assert by == pytest.approx([-hit[0] for hit in expected], abs=2e-12)
            plain = [hit.score for hit in answer.hits]
            assert plain == pytest.approx([hit[2] for hit in expected], abs=2e-12)
            assert answer.rows_scanned == 30

    def test_query_without_any_weighted_word_is_ranked_plainly_and_says_so(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        places.add(unit_rows(1, 9))
        vector = np.zeros(DIMENSION, dtype=np.float32)
        vector[0] = 1.0
        request = places.request(places.query(vector), k=9)
        answer = port().search(request.model_copy(update={"word_weights": (0.0, 1.0, 1.0, 1.0)}))
        assert_answers(answer, places.brute_force(vector, 9))
        assert {hit.weighted_score for hit in answer.hits} == {None}

    def test_weights_that_do_not_fit_the_descriptor_are_refused(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        places.add(unit_rows(1, 3))
        request = places.request(places.query(unit_rows(2, 1)[0]))
        with pytest.raises(InvalidRequest) as caught:
            port().search(request.model_copy(update={"word_weights": (1.0,) * 5}))
        assert caught.value.code == "word_weights_unfit"

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
            assert response.hits[0].score == pytest.approx(-1)
        assert not search.search(places.request(places.query(vector), tags=("Needle",))).hits

    def test_a_filter_and_exclusions_and_the_least_score_work_together(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        photo_ids = places.add(unit_rows(1, 30), about=lambda row: {"place": f"room {row % 3}"})
        passing = set(photo_ids[1::3]) - {photo_ids[4]}
        vector = places.rows[photo_ids[4]]
        expected = places.brute_force(vector, 30, passing)
        bound = (expected[4][1] + expected[5][1]) / 2
        request = places.request(
            places.reference(photo_ids[4]),
            k=30,
            min_score=bound,
            exclude=(photo_ids[4],),
            place="room 1",
        )
        assert_answers(port().search(request), expected[:5])

    def test_what_is_changed_of_a_photo_is_seen_by_the_next_call_without_reading_its_chunk(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        first, second = places.add(unit_rows(1, 5)), places.add(unit_rows(2, 5))
        vector = unit_rows(3, 1)[0]
        reference = places.query(vector)
        search = port()
        search.search(places.request(reference))
        for key in places.chunk_keys():
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

    def test_labelled_queries_are_never_answered_and_can_be_asked_with(
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

    def test_map_without_photos_answers_nothing(self, places: SmallMap, port: OpenPort) -> None:
        response = port().search(places.request(places.query(unit_rows(1, 1)[0])))
        assert (response.hits, response.missing) == ((), ())

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

    def test_version_that_never_comes_is_search_behind(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        places.add(unit_rows(1, 3))
        reference = places.query(unit_rows(2, 1)[0])
        search = port(search_wait_seconds=0.05, search_timeout_seconds=1)
        with pytest.raises(Unavailable) as caught:
            search.search(places.request(reference, min_version=places.version + 1))
        assert caught.value.code == "search_behind"
        assert search.search(places.request(reference)).hits, "others are served as before"

    def test_version_that_comes_while_it_is_waited_for_is_answered(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        places.add(unit_rows(1, 3))
        vector = unit_rows(2, 1)
        request = places.request(places.query(vector[0]), min_version=places.version + 1)
        search = port(search_wait_seconds=30)
        search.search(places.request((request.object_key, 0)))
        publisher = threading.Timer(0.05, places.add, [vector])
        publisher.start()
        response = search.search(request)
        publisher.join()
        assert response.hits[0].score == pytest.approx(1.0)
        assert response.snapshot_version == request.min_version

    def test_deleted_photo_is_gone_in_the_next_call(self, places: SmallMap, port: OpenPort) -> None:
        photo_ids = places.add(unit_rows(1, 6)) + places.add(unit_rows(2, 6))
        vector = places.rows[photo_ids[3]]
        reference = places.query(vector)
        search = port()
        assert search.search(places.request(reference)).hits[0].photo_id == photo_ids[3]
        for gone in (photo_ids[3], photo_ids[9]):
            places.delete(gone)
            response = search.search(places.request(reference, k=20))
            assert_answers(response, places.brute_force(vector, 20))

    def test_photo_deleted_before_anything_was_loaded_is_never_answered(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        photo_ids = places.add(unit_rows(1, 6))
        places.delete(photo_ids[0])
        response = port().search(places.request(places.query(unit_rows(1, 1)[0]), k=20))
        assert {hit.photo_id for hit in response.hits} == set(photo_ids[1:])

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
            places.store.put(key, _damaged(whole, damage))
        for photo_id in broken:
            del places.rows[photo_id]
        vector = unit_rows(4, 1)[0]
        search = port()
        response = search.search(places.request(places.query(vector), k=20))
        assert response.missing == (key,)
        assert (response.certificate, response.certified_k) == ("none", 0)
        assert_answers(response, places.brute_force(vector, 20))
        assert search.status().missing == (key,)

    @pytest.mark.parametrize("damage", ["flipped", "truncated"])
    def test_damaged_descriptor_is_no_query(
        self, places: SmallMap, port: OpenPort, damage: str
    ) -> None:
        photo_ids = places.add(unit_rows(1, 5))
        reference = places.reference(photo_ids[2])
        places.store.put(reference[0], _damaged(places.store.get(reference[0]), damage))
        with pytest.raises(Unavailable) as caught:
            port().search(places.request(reference))
        assert caught.value.code == "chunk_unreadable"

    def test_descriptor_that_is_no_longer_kept_is_gone(
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

    def test_maps_do_not_see_each_other(
        self, places: SmallMap, port: OpenPort, catalog: Catalog, store: FolderStore
    ) -> None:
        other = SmallMap(catalog, store)
        places.add(unit_rows(1, 5))
        other.add(unit_rows(1, 5))
        search = port()
        for one in (places, other):
            response = search.search(one.request(one.query(unit_rows(1, 1)[0]), k=20))
            assert {hit.photo_id for hit in response.hits} == set(one.rows)

    def test_status_tells_rows_versions_and_memory(self, places: SmallMap, port: OpenPort) -> None:
        photo_ids = places.add(unit_rows(1, 5), dead=1)
        places.delete(photo_ids[2])
        search = port()
        search.search(places.request(places.query(unit_rows(2, 1)[0])))
        status = search.status()
        assert status.rows == 3
        assert status.versions == {places.generation_id: places.version}
        assert status.resident_bytes >= 5 * DIMENSION * 4
        assert status.missing == ()

    def test_queries_from_many_threads_are_exact_while_photos_come_and_go(
        self, places: SmallMap, port: OpenPort
    ) -> None:
        """What a query may see is a whole version: every photo with its own score."""
        seen: dict[UUID, Rows] = {}
        seen |= dict(zip(places.add(unit_rows(0, 20)), unit_rows(0, 20), strict=True))
        vector = unit_rows(99, 1)[0]
        reference = places.query(vector)
        search = port()
        responses: list[SearchResponse] = []
        done = threading.Event()

        def ask() -> None:
            while not done.is_set():
                responses.append(search.search(places.request(reference, k=500)))

        threads = [threading.Thread(target=ask) for _ in range(3)]
        for thread in threads:
            thread.start()
        try:
            for seed in range(1, 6):
                rows = unit_rows(seed, 4)
                photo_ids = places.add(rows)
                seen |= dict(zip(photo_ids, rows, strict=True))
                places.delete(photo_ids[1])
                places.merge()
        finally:
            done.set()
            for thread in threads:
                thread.join()
        exact = vector.astype(np.float64) / np.linalg.norm(vector.astype(np.float64))
        for response in responses:
            for hit in response.hits:
                assert hit.score == pytest.approx(float(seen[hit.photo_id] @ exact), abs=1e-6)
        final = search.search(places.request(reference, k=500))
        assert_answers(final, places.brute_force(vector, 500))


def _damaged(whole: bytes, damage: str) -> bytes:
    if damage == "truncated":
        return whole[:-5]
    return whole[:-1] + bytes([whole[-1] ^ 1])


class TestSearchWorker(SearchPortContract):
    @pytest.fixture
    def port(self, catalog: Catalog, store: FolderStore, settings: Settings) -> OpenPort:
        def open_port(**changes: object) -> SearchBackend:
            return SearchWorker(catalog, store, settings.model_copy(update=changes))

        return open_port

    def test_repaired_chunk_is_served_again_without_a_new_version(
        self,
        catalog: Catalog,
        store: FolderStore,
        settings: Settings,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setattr(read_retries, "FIRST_RETRY_SECONDS", 0.0)
        places = SmallMap(catalog, store)
        places.add(unit_rows(1, 5))
        (key,) = places.chunk_keys()
        whole = store.get(key)
        store.put(key, _damaged(whole, "flipped"))
        worker = SearchWorker(catalog, store, settings)
        worker.sync()
        assert worker.status().missing == (key,)
        store.put(key, whole)
        worker.sync()
        assert worker.status().missing == ()
        assert worker.status().rows == 5

    def test_damaged_chunk_is_not_read_again_with_every_look_and_every_new_version(
        self,
        catalog: Catalog,
        store: FolderStore,
        settings: Settings,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        places = SmallMap(catalog, store)
        places.add(unit_rows(1, 5))
        (key,) = places.chunk_keys()
        store.put(key, _damaged(store.get(key), "flipped"))
        opened: list[str] = []
        open_object = store.open

        def counted(key: str) -> BinaryIO:
            opened.append(key)
            return open_object(key)

        monkeypatch.setattr(store, "open", counted)
        worker = SearchWorker(catalog, store, settings)
        for seed in (2, 3):
            worker.sync()
            worker.sync()
            places.add(unit_rows(seed, 5))
            request = places.request(places.query(unit_rows(seed, 1)[0]), k=20)
            assert worker.search(request).missing == (key,)
        assert opened.count(key) == 1

    def test_chunk_that_is_truncated_while_it_is_mapped_is_left_out(
        self,
        catalog: Catalog,
        store: FolderStore,
        settings: Settings,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """Reading such a mapping would end the process. A deleted file is read on."""
        monkeypatch.setattr(read_retries, "FIRST_RETRY_SECONDS", 0.0)
        monkeypatch.setattr(worker_module, "FILE_CHECK_SECONDS", 0.0)
        places = SmallMap(catalog, store)
        places.add(unit_rows(1, 5))
        kept = places.reference(places.add(unit_rows(2, 5))[0])[0]
        (key,) = set(places.chunk_keys()) - {kept}
        worker = SearchWorker(
            catalog, store, settings.model_copy(update={"search_memory_bytes": 0})
        )
        worker.sync()
        assert worker.status().rows == 10
        whole = store.get(key)
        os.truncate(store.path(key), 200)
        store.delete(kept)
        worker.sync()
        assert (worker.status().missing, worker.status().rows) == ((key,), 5)
        store.put(key, whole)
        worker.sync()
        assert (worker.status().missing, worker.status().rows) == ((), 10)

    def test_following_forgets_what_is_no_longer_searched(
        self, catalog: Catalog, store: FolderStore, settings: Settings
    ) -> None:
        places = SmallMap(catalog, store)
        places.add(unit_rows(1, 5))
        worker = SearchWorker(catalog, store, settings)
        worker.sync()
        assert worker.status().versions == {places.generation_id: places.version}
        with catalog.write() as session:
            session.get_one(Generation, places.generation_id).state = GenerationState.RETIRED
        worker.sync()
        assert worker.status().versions == {}
        assert worker.status().resident_bytes == 0

    def test_followed_versions_reuse_the_chunks_that_are_loaded(
        self, catalog: Catalog, store: FolderStore, settings: Settings
    ) -> None:
        places = SmallMap(catalog, store)
        first = places.add(unit_rows(1, 5))
        worker = SearchWorker(catalog, store, settings)
        worker.sync()
        store.delete(places.reference(first[0])[0])
        places.add(unit_rows(2, 5))
        worker.sync()
        assert worker.status().missing == (), "a loaded chunk was read again"
        assert worker.status().rows == 10


@whatever_the_catalog
class TestSearchWorkerByCodes(TestSearchWorker):
    """The same promises where rows are told apart by their codes first."""

    certificate = "statistical"

    @pytest.fixture(autouse=True)
    def by_codes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        always_by_codes(monkeypatch)


@whatever_the_catalog
class TestSearchWorkerByInt8(TestSearchWorker):
    """The same promises where rows of middle length are told apart by their int8 codes."""

    certificate = "bound"

    @pytest.fixture(autouse=True)
    def by_int8(self, monkeypatch: pytest.MonkeyPatch) -> None:
        always_by_int8(monkeypatch)

    @pytest.mark.parametrize("damage", ["flipped", "truncated", "gone"])
    def test_codes_that_are_damaged_or_gone_are_made_again(
        self, places: SmallMap, port: OpenPort, settings: Settings, damage: str
    ) -> None:
        places.add(unit_rows(1, 30))
        vector = unit_rows(2, 1)[0]
        first = port().search(places.request(places.query(vector)))
        (path,) = settings.search_cache_folder(SINGLE_SHARD).rglob("*.int8")
        whole = path.read_bytes()
        path.unlink()
        if damage != "gone":
            path.write_bytes(_damaged(whole, damage))
        again = port().search(places.request(places.query(vector)))
        assert again == first
        assert path.read_bytes() == whole

    def test_without_room_for_codes_every_row_is_compared(
        self, places: SmallMap, port: OpenPort, settings: Settings
    ) -> None:
        places.add(unit_rows(1, 30))
        settings.search_cache_folder(SINGLE_SHARD).parent.mkdir(parents=True, exist_ok=True)
        settings.search_cache_folder(SINGLE_SHARD).write_text("no folder can be here")
        vector = unit_rows(2, 1)[0]
        response = port().search(places.request(places.query(vector)))
        assert_answers(response, places.brute_force(vector))
        assert response.certificate == "exhaustive"


@whatever_the_catalog
class TestSearchWorkerDeterministic(TestSearchWorker):
    """The same promises of `mode=deterministic`, whose codes are made when they are asked for."""

    certificate = "bound"

    @pytest.fixture(autouse=True)
    def deterministic(self, monkeypatch: pytest.MonkeyPatch) -> None:
        int8_on_demand(monkeypatch)
        monkeypatch.setattr(SmallMap, "mode", Mode.DETERMINISTIC)

    def test_codes_are_made_once_asked_for_and_counted(
        self, places: SmallMap, port: OpenPort, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        places.add(unit_rows(1, 30))
        search = port()
        reference = places.query(unit_rows(2, 1)[0])
        with monkeypatch.context() as patch:
            patch.setattr(SmallMap, "mode", Mode.DENSE)
            dense = search.search(places.request(reference))
        assert dense.certificate == "exhaustive"
        before = search.status().resident_bytes
        found = search.search(places.request(reference))
        assert found.certificate == "bound"
        assert found.hits == dense.hits
        assert search.status().resident_bytes == before + 30 * 64  # 12 numbers are padded to 64

    def test_codes_that_take_long_refuse_with_progress_and_come(
        self, places: SmallMap, port: OpenPort, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        go_on = threading.Event()
        make = ChunkLoader.load_int8_codes

        def slowly(self: ChunkLoader, object_key: str, stored: StoredChunk) -> Int8Codes:
            assert go_on.wait(60)
            return make(self, object_key, stored)

        monkeypatch.setattr(ChunkLoader, "load_int8_codes", slowly)
        places.add(unit_rows(1, 30))
        vector = unit_rows(2, 1)[0]
        request = places.request(places.query(vector))
        search = port(search_wait_seconds=0.01)
        for _ in range(2):
            with pytest.raises(Unavailable) as caught:
                search.search(request)
            assert caught.value.code == "codes_being_made"
            assert caught.value.extra["retry_after_seconds"] >= 1
            assert (caught.value.extra["done"], caught.value.extra["rows"]) == (0, 30)
        auto = search.search(request.model_copy(update={"mode": Mode.AUTO}))
        assert_answers(auto, places.brute_force(vector))
        go_on.set()
        response = _once_made(search, request)
        assert_answers(response, places.brute_force(vector))
        assert response.certificate == "bound"

    def test_codes_that_can_not_be_kept_are_refused_and_tried_again(
        self, places: SmallMap, port: OpenPort, settings: Settings
    ) -> None:
        places.add(unit_rows(1, 30))
        vector = unit_rows(2, 1)[0]
        request = places.request(places.query(vector))
        search = port()
        search.search(request.model_copy(update={"mode": Mode.AUTO}))
        folder = settings.search_cache_folder(SINGLE_SHARD)
        shutil.rmtree(folder)
        folder.write_text("no folder can be here")
        with pytest.raises(Unavailable) as caught:
            search.search(request)
        assert caught.value.code == "codes_not_made"
        folder.unlink()
        assert_answers(search.search(request), places.brute_force(vector))


@whatever_the_catalog
class TestSearchWorkerOnADevice(TestSearchWorker):
    """The same promises where the rows lie on a device: PyTorch's CPU stands for a GPU."""

    certificate = "bound"

    @pytest.fixture(params=["float16", "int8"])
    def port(
        self,
        request: pytest.FixtureRequest,
        catalog: Catalog,
        store: FolderStore,
        settings: Settings,
        monkeypatch: pytest.MonkeyPatch,
    ) -> OpenPort:
        always_by_int8(monkeypatch)
        monkeypatch.setattr(executor, "sign_codes_pay_off", lambda selected, k: selected > 0)
        monkeypatch.setattr(gpu, "ROW_FORMATS", (request.param,))

        def open_port(**changes: object) -> SearchBackend:
            device = gpu.GpuDevice(torch.device("cpu"), lambda: 1e9, 0)
            worker = SearchWorker(
                catalog, store, settings.model_copy(update=changes), device=device
            )
            worker.sync()
            return worker

        return open_port

    def test_status_tells_what_lies_on_the_device(self, places: SmallMap, port: OpenPort) -> None:
        places.add(unit_rows(1, 40))
        search = port()
        (device,) = search.status().devices
        assert device.name == "cpu"
        assert list(device.generations) == [places.generation_id]
        before = device.resident_bytes
        places.add(unit_rows(2, 40))
        response = search.search(places.request(places.query(unit_rows(3, 1)[0])))
        assert response.certificate == "bound", "a new chunk is on the device at once"
        assert search.status().devices[0].resident_bytes == 2 * before
        assert search.status().devices[0].failure is None

    def test_metrics_tell_what_lies_on_the_device(self, places: SmallMap, port: OpenPort) -> None:
        places.add(unit_rows(1, 40))
        search = port()
        assert isinstance(search, SearchWorker)
        told = MeteredSearch(search).render().decode()
        bytes_there = search.status().devices[0].resident_bytes
        assert f'placewise_search_device_resident_bytes{{device="cpu"}} {bytes_there:.1f}' in told
        assert 'placewise_search_device_failed{device="cpu"} 0.0' in told


def _once_made(search: SearchBackend, request: SearchRequest) -> SearchResponse:
    for _ in range(1000):
        try:
            return search.search(request)
        except Unavailable as error:
            if error.code != "codes_being_made":
                raise
            time.sleep(0.01)
    raise AssertionError("the codes never came")


@pytest.mark.parametrize(
    ("catalog", "replicas"),
    [("sqlite", (1,)), ("postgresql", (2, 1, 1))],
    ids=["one shard", "three shards, one of them twice"],
    indirect=["catalog"],
)
class TestSearchOverHttp(SearchPortContract):
    """The same promises, with HTTP between and the map's slots spread over workers."""

    @pytest.fixture
    def port(
        self,
        replicas: tuple[int, ...],
        catalog: Catalog,
        store: FolderStore,
        settings: Settings,
    ) -> Iterator[OpenPort]:
        with contextlib.ExitStack() as running:

            def open_port(**changes: object) -> SearchBackend:
                # Whoever waits longer for a version waits longer for the shards, too.
                wait = float(str(changes.get("search_wait_seconds", settings.search_wait_seconds)))
                patience = {"search_timeout_seconds": max(10.0, 5 * wait)}
                own = settings.model_copy(update=patience | changes)
                tier = SearchTier(catalog, store, own, replicas)
                tier.follow()  # a search brings only one replica of a shard up to date
                return running.enter_context(tier).port

            yield open_port

    def test_codes_that_are_being_made_are_no_reason_to_leave_shards_out(
        self, places: SmallMap, port: OpenPort, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        int8_on_demand(monkeypatch)
        go_on = threading.Event()
        make = ChunkLoader.load_int8_codes

        def slowly(self: ChunkLoader, object_key: str, stored: StoredChunk) -> Int8Codes:
            assert go_on.wait(60)
            return make(self, object_key, stored)

        monkeypatch.setattr(ChunkLoader, "load_int8_codes", slowly)
        for slot in range(3):
            places.add(unit_rows(slot, 10), slot=slot)
        vector = unit_rows(9, 1)[0]
        request = places.request(places.query(vector))
        request = request.model_copy(update={"mode": Mode.DETERMINISTIC})
        search = port(search_wait_seconds=0.2, search_timeout_seconds=1)
        try:
            with pytest.raises(Unavailable) as caught:
                search.search(request)
        finally:
            go_on.set()
        assert caught.value.code == "codes_being_made"
        assert caught.value.extra["retry_after_seconds"] >= 1
        response = _once_made(search, request)
        assert_answers(response, places.brute_force(vector))
        assert response.certificate == "bound"


class AddDeleteMerge(RuleBasedStateMachine):
    """Any order of publishing, deleting, merging and following equals a brute-force model."""

    migrated: Path  # a catalog that every example copies: migrating takes longer than an example

    def __init__(self) -> None:
        super().__init__()
        self.seed = 0
        self.references: list[tuple[Reference, Rows]] = []

    @initialize()
    def open(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="pw-search-"))
        shutil.copy(self.migrated, self.folder / "catalog.sqlite")
        self.catalog = Catalog(f"sqlite:///{self.folder / 'catalog.sqlite'}")
        self.store = FolderStore(self.folder / "objects")
        self.places = SmallMap(self.catalog, self.store)
        self.worker = SearchWorker(self.catalog, self.store, Settings())

    def teardown(self) -> None:
        if hasattr(self, "folder"):
            self.catalog.close()
            shutil.rmtree(self.folder)

    @rule(count=st.integers(1, 4), slot=st.integers(0, 1), dead=st.integers(0, 2))
    def add(self, count: int, slot: int, dead: int) -> None:
        self.seed += 1
        self.places.add(unit_rows(self.seed, count), slot, dead)

    @rule(slot=st.integers(0, 1))
    def add_duplicates(self, slot: int) -> None:
        self.places.add(np.repeat(unit_rows(0, 1), 2, axis=0), slot)

    @rule(which=st.integers(0, 1000))
    def delete(self, which: int) -> None:
        assume(self.places.rows)
        photo_ids = sorted(self.places.rows)
        self.places.delete(photo_ids[which % len(photo_ids)])

    @rule(slot=st.integers(0, 1))
    def merge(self, slot: int) -> None:
        assert self.places.merge(slot)

    @rule()
    def follow(self) -> None:
        self.worker.sync()

    @rule()
    def forget_everything(self) -> None:
        self.worker = SearchWorker(self.catalog, self.store, Settings())

    @rule(which=st.integers(0, 1000))
    def remember_a_reference(self, which: int) -> None:
        """Later merges supersede its chunk, and it must still mean this photo's descriptor."""
        assume(self.places.rows)
        photo_ids = sorted(self.places.rows)
        photo_id = photo_ids[which % len(photo_ids)]
        self.references.append((self.places.reference(photo_id), self.places.rows[photo_id]))

    @rule(k=st.integers(1, 30))
    def ask(self, k: int) -> None:
        vector = unit_rows(1000 + self.seed, 1)[0]
        self.check(self.places.query(vector), vector, k)
        self.check(self.places.query(unit_rows(0, 1)[0]), unit_rows(0, 1)[0], k)
        for reference, remembered in self.references:
            self.check(reference, remembered, k)

    def check(self, reference: Reference, vector: Rows, k: int) -> None:
        response = self.worker.search(self.places.request(reference, k=k))
        assert_answers(response, self.places.brute_force(vector, k))
        assert response.missing == ()

    @invariant()
    def rows_in_the_store_are_those_of_their_photos(self) -> None:
        if not hasattr(self, "places"):
            return
        for photo_id, row in self.places.rows.items():
            key, number = self.places.reference(photo_id)
            np.testing.assert_array_equal(decode_rows(self.store.get(key))[number], row)
            assert self.store.head(manifest_key(key)) is not None


@pytest.fixture
def migrated(tmp_path: Path) -> None:
    path = tmp_path / "migrated.sqlite"
    catalog = Catalog(f"sqlite:///{path}")
    migrate(catalog)
    catalog.close()  # the last connection writes everything into the one file
    AddDeleteMerge.migrated = path


@pytest.mark.usefixtures("migrated")
@pytest.mark.parametrize("by", ["dense", "sign codes", "int8 codes"])
def test_no_order_of_adding_deleting_and_merging_attaches_a_score_to_another_photo(
    by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if by == "sign codes":
        always_by_codes(monkeypatch)
    elif by == "int8 codes":
        always_by_int8(monkeypatch)
    run_state_machine_as_test(
        AddDeleteMerge,
        settings=how(
            max_examples=15,
            stateful_step_count=15,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )
