"""Compaction: small chunks are merged, whatever changes meanwhile."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any
from uuid import UUID

import pytest
from hypothesis import given
from hypothesis import strategies as some

from services.steward.tasks import compaction
from services.steward.tasks.garbage_collection import collect_deleted_photos
from shared.catalog.chunks import Chunk, Descriptor, count_searchable, list_live_chunks
from shared.catalog.database.base import db_now_plus
from shared.catalog.generations import Generation, GenerationState
from shared.catalog.photos import Photo
from shared.ids import new_id
from shared.storage.chunks import WrittenChunk, features_key, read_chunk, write_chunk
from shared.storage.read_retries import ReadRetries
from tests.integration.harness import same
from tests.integration.steward.chunk_map import HOUR_SECONDS, ChunkMap, Features
from tests.support.catalog_rows import row_of, stored_rows
from tests.support.threads import at_once

pytestmark = pytest.mark.databases("postgresql")


def test_new_chunks_become_one_once_there_are_enough(chunk_map: ChunkMap) -> None:
    photo_ids = sum_of(chunk_map.chunks(2, 3))
    assert chunk_map.merge(3) == 0
    assert chunk_map.live() == [2, 3]
    photo_ids += sum_of(chunk_map.chunks(1))
    version = chunk_map.version()
    assert chunk_map.merge(3) == 1
    assert chunk_map.live() == [6]
    chunk_map.check_rows(photo_ids)
    assert chunk_map.version() == version + 1  # search workers look again
    assert chunk_map.merge(3) == 0  # nothing is left to do


def sum_of(parts: list[list[UUID]]) -> list[UUID]:
    return [photo_id for part in parts for photo_id in part]


def test_merged_chunks_are_nearly_full_and_never_exceed_their_rows(chunk_map: ChunkMap) -> None:
    photo_ids = sum_of(chunk_map.chunks(3, 4, 3, 5, 5, 9, 1, 2))
    # The last two wait for more, and 9 rows are as good as full.
    assert chunk_map.merge(chunk_rows=10) == 2
    assert chunk_map.live() == [9, 1, 2, 10, 10]
    with chunk_map.catalog.read() as session:
        sealed = [chunk.sealed for chunk in list_live_chunks(session, chunk_map.generation_id)]
    assert sealed == [False, False, False, True, True]
    assert chunk_map.merge(2, chunk_rows=10) == 1
    assert chunk_map.live() == [9, 10, 10, 3]
    assert chunk_map.merge(2, chunk_rows=10) == 0
    chunk_map.check_rows(photo_ids)


@given(sizes=some.lists(some.integers(1, 20), max_size=80))
def test_number_of_chunks_is_bounded_by_that_of_rows(sizes: list[int]) -> None:
    chunks: list[Chunk] = []
    for rows in sizes:
        chunks.append(Chunk(id=new_id(), rows=rows, sealed=False))
        while groups := compaction.group_chunks([c for c in chunks if c.rows < 12], 16, 4):
            for group in groups:
                assert len(group) > 1
                merged = sum(chunk.rows for chunk in group)
                assert merged <= 16
                chunks = [chunk for chunk in chunks if chunk not in group]
                chunks.append(Chunk(id=new_id(), rows=merged, sealed=True))
    assert len(chunks) <= 2 * sum(sizes) / 16 + 4 * 4


def test_a_row_is_merged_at_most_twice(
    chunk_map: ChunkMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: Counter[UUID] = Counter()

    def count(*arguments: Any, **options: Any) -> WrittenChunk:
        written.update(options["photo_ids"])
        return write_chunk(*arguments, **options)

    monkeypatch.setattr(compaction, "write_chunk", count)
    photo_ids = []
    for _ in range(24):
        photo_ids += sum_of(chunk_map.chunks(2))
        chunk_map.merge(2, chunk_rows=16)
        assert len(chunk_map.live()) <= 3 + 4
    assert set(written.values()) <= {1, 2}
    chunk_map.check_rows(photo_ids)


def test_rows_of_deleted_photos_are_dropped(chunk_map: ChunkMap) -> None:
    first, second = chunk_map.chunks(5, 5)
    chunk_map.delete(first[0])
    assert chunk_map.merge() == 0  # a fifth is not worth it
    chunk_map.delete(first[4])
    assert chunk_map.merge() == 1
    assert chunk_map.live() == [5, 3]
    chunk_map.check_rows([*first[1:4], *second])


FEATURES = ("xfeat@1", [b"one", b"two"])


@pytest.mark.parametrize(
    ("first", "second", "merged"),
    [
        (FEATURES, ("xfeat@1", [b"", b"four"]), ("xfeat@1", [b"two", b"", b"four"])),
        (FEATURES, None, ("xfeat@1", [b"two", b"", b""])),
        (None, FEATURES, ("xfeat@1", [b"", b"one", b"two"])),
        (FEATURES, ("other@1", [b"", b"four"]), ("other@1", [b"", b"", b"four"])),
        (None, None, None),
    ],
)
def test_local_features_are_merged_row_by_row_by_the_newest_model(
    chunk_map: ChunkMap, first: Features, second: Features, merged: Features
) -> None:
    photo_ids = sum_of(chunk_map.chunks_with_features(first, second))
    chunk_map.delete(photo_ids[0])
    assert chunk_map.merge_all()
    assert chunk_map.features() == merged
    chunk_map.check_rows(photo_ids[1:])


@pytest.mark.parametrize("damage", ["changed", "missing"])
def test_damaged_local_features_are_dropped_and_the_rows_are_merged(
    chunk_map: ChunkMap, damage: str
) -> None:
    photo_ids = sum_of(chunk_map.chunks_with_features(FEATURES, ("xfeat@1", [b"3", b"4"])))
    with chunk_map.catalog.read() as session:
        key = features_key(list_live_chunks(session, chunk_map.generation_id)[0].object_key)
    if damage == "changed":
        chunk_map.store.put(key, chunk_map.store.get(key)[:-1] + b"x")
    else:
        chunk_map.store.delete(key)
    assert chunk_map.merge_all()
    assert chunk_map.features() == ("xfeat@1", [b"", b"", b"3", b"4"])
    chunk_map.check_rows(photo_ids)


def test_rows_that_no_photo_ever_had_are_dropped(chunk_map: ChunkMap) -> None:
    (photo_ids,) = chunk_map.chunks(4)
    with chunk_map.catalog.write() as session:  # two jobs of the batch were taken over
        for photo_id in photo_ids[:2]:
            session.delete(session.get_one(Descriptor, (chunk_map.generation_id, photo_id)))
    assert chunk_map.merge() == 1
    assert chunk_map.live() == [2]
    chunk_map.check_rows(photo_ids[2:])


def test_concurrent_compactions_merge_once(
    chunk_map: ChunkMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo_ids = sum_of(chunk_map.chunks(2, 3))
    together = threading.Barrier(2)

    def read_together(*arguments: Any) -> Any:
        if arguments[1] in first_keys:
            together.wait(timeout=30)  # both have looked at the catalog before one commits
        return read_chunk(*arguments)

    with chunk_map.catalog.read() as session:
        first_keys = {list_live_chunks(session, chunk_map.generation_id)[0].object_key}
    monkeypatch.setattr(compaction, "read_chunk", read_together)
    assert sorted(at_once(*[chunk_map.merge_all] * 2)) == [False, True]
    assert chunk_map.live() == [5]
    chunk_map.check_rows(photo_ids)


@pytest.fixture
def while_merging(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], None]:
    """Has something done after the merge has looked at the catalog, before it commits."""

    def meanwhile(do: Callable[[], object]) -> None:
        calls = iter([do])

        def write(*arguments: Any, **options: Any) -> Any:
            written = write_chunk(*arguments, **options)
            for act in calls:
                act()
                break
            return written

        monkeypatch.setattr(compaction, "write_chunk", write)

    return meanwhile


Meanwhile = Callable[[Callable[[], object]], None]


def test_a_photo_deleted_while_merging_does_not_come_back(
    chunk_map: ChunkMap, while_merging: Meanwhile
) -> None:
    first, second = chunk_map.chunks(2, 3)
    while_merging(lambda: chunk_map.delete(first[0]))
    assert chunk_map.merge_all()
    with chunk_map.catalog.read() as session:
        assert count_searchable(session, chunk_map.generation_id) == 4
    rows = stored_rows(chunk_map.catalog, chunk_map.store, chunk_map.generation_id)
    assert all(same(row, row_of(photo_id)) for photo_id, row in rows.items())
    assert chunk_map.merge_all()
    chunk_map.check_rows([first[1], *second])


def test_a_photo_forgotten_while_merging_does_not_come_back(
    chunk_map: ChunkMap, while_merging: Meanwhile
) -> None:
    first, second = chunk_map.chunks(2, 3)

    def forget() -> None:
        chunk_map.delete(first[0])
        chunk_map.change(Photo, first[0], deleted_at=db_now_plus(-2 * HOUR_SECONDS))
        collect_deleted_photos(chunk_map.catalog, chunk_map.store, HOUR_SECONDS)

    while_merging(forget)
    assert chunk_map.merge_all()
    assert chunk_map.live() == [5]  # its row is dead
    chunk_map.check_rows([first[1], *second])


def test_a_chunk_that_arrives_while_merging_is_not_lost(
    chunk_map: ChunkMap, while_merging: Meanwhile
) -> None:
    first, second = chunk_map.chunks(2, 3)
    late: list[UUID] = []
    while_merging(lambda: late.extend(sum_of(chunk_map.chunks(2))))
    assert chunk_map.merge_all()
    assert sorted(chunk_map.live()) == [2, 5]
    chunk_map.check_rows([*first, *second, *late])


def test_a_corrupt_chunk_stays_and_others_are_merged(chunk_map: ChunkMap) -> None:
    photo_ids = sum_of(chunk_map.chunks(5, 5, 3, 3))
    retries = ReadRetries()
    with chunk_map.catalog.read() as session:
        broken = list_live_chunks(session, chunk_map.generation_id)[0].object_key
    whole = chunk_map.store.get(broken)
    chunk_map.store.put(broken, whole[:-1] + bytes([whole[-1] ^ 1]))
    assert chunk_map.merge(2, retries) == 0
    assert chunk_map.merge(2, retries) == 1
    assert chunk_map.live() == [5, 11]
    chunk_map.store.put(broken, whole)
    chunk_map.check_rows(photo_ids)


def test_a_corrupt_chunk_is_not_read_with_every_round_of_merging(
    chunk_map: ChunkMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    chunk_map.chunks(1, 1)
    with chunk_map.catalog.read() as session:
        broken = list_live_chunks(session, chunk_map.generation_id)[0].object_key
    whole = chunk_map.store.get(broken)
    chunk_map.store.put(broken, whole[:-1])
    retries = ReadRetries()
    assert chunk_map.merge(2, retries) == 0
    chunk_map.store.put(broken, whole)
    assert chunk_map.merge(2, retries) == 0, "its pause is not over"
    monkeypatch.setattr("shared.storage.read_retries.time.monotonic", lambda: float("inf"))
    assert chunk_map.merge(2, retries) == 1


def test_generations_that_no_longer_answer_are_not_merged(chunk_map: ChunkMap) -> None:
    chunk_map.chunks(1, 1, 1)
    chunk_map.change(Generation, chunk_map.generation_id, state=GenerationState.RETIRED)
    assert chunk_map.merge(2) == 0
