"""Merging the shards' answers: the order of one scan over all rows, and nothing glossed over."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from hypothesis import given
from hypothesis import strategies as st

from shared.config.shards import Shard
from shared.ids import new_id
from shared.search_api.client import merge_responses, merge_statuses
from shared.search_api.protocol import (
    EXHAUSTIVE,
    NONE,
    ReplicationLag,
    SearchHit,
    SearchResponse,
    SearchStatus,
)


def answer(*hits: tuple[int, float], **changes: Any) -> SearchResponse:
    """`hits` are (photo, score), in any order."""
    ordered = sorted(hits, key=lambda hit: (-hit[1], hit[0]))
    values: dict[str, Any] = {
        "certificate": EXHAUSTIVE,
        "rows_scanned": 10,
        "rows_reranked": 2,
        "snapshot_version": 7,
    }
    return SearchResponse(
        hits=tuple(SearchHit(photo_id=UUID(int=number), score=score) for number, score in ordered),
        **(values | changes),
    )


def ranked(response: SearchResponse) -> list[tuple[int, float]]:
    return [(hit.photo_id.int, hit.score) for hit in response.hits]


@given(
    scores=st.lists(st.sampled_from([-1.0, 0.0, 0.25, 0.5, 1.0]), max_size=30),
    of=st.integers(1, 5),
    k=st.integers(1, 12),
)
def test_the_merged_order_is_that_of_one_list_also_for_equal_scores(
    scores: list[float], of: int, k: int
) -> None:
    shards: list[list[tuple[int, float]]] = [[] for _ in range(of)]
    for number, score in enumerate(scores):
        shards[number * 7 % of].append((number, score))
    merged = merge_responses([answer(*hits) for hits in shards], k)
    whole = sorted(enumerate(scores), key=lambda hit: (-hit[1], hit[0]))
    assert ranked(merged) == whole[:k]


def test_a_photo_that_two_shards_have_for_a_moment_is_answered_once() -> None:
    merged = merge_responses([answer((1, 0.9), (2, 0.8)), answer((1, 0.7), (3, 0.6))], k=3)
    assert ranked(merged) == [(1, 0.9), (2, 0.8), (3, 0.6)]


def test_the_weakest_certificate_and_the_largest_error_count() -> None:
    exact = merge_responses([answer(), answer()], 1)
    assert (exact.certificate, exact.max_z) == (EXHAUSTIVE, None)
    newer = answer(certificate="of the future", max_z=1.5)
    merged = merge_responses([answer(), newer, answer(max_z=3.0)], 1)
    assert (merged.certificate, merged.max_z) == ("of the future", 3.0)
    gaps: list[tuple[tuple[str, ...], list[Shard]]] = [(("chunks/a",), []), ((), [Shard(1, 2)])]
    for missing, away in gaps:
        merged = merge_responses([answer((1, 0.9), missing=missing)], 1, away)
        assert merged.certificate == NONE, "it lacks a part of the map"


def test_sums_least_version_and_missing_chunks_are_merged() -> None:
    merged = merge_responses(
        [
            answer(snapshot_version=9, rows_scanned=3, rows_reranked=1, missing=("chunks/a",)),
            answer(snapshot_version=8, rows_scanned=4, rows_reranked=2, missing=("chunks/b",)),
        ],
        k=1,
        unreachable=[Shard(3, 4), Shard(1, 4)],
    )
    assert (merged.snapshot_version, merged.rows_scanned, merged.rows_reranked) == (8, 7, 3)
    assert merged.missing == ("chunks/a", "chunks/b", "shard 1/4", "shard 3/4")


def test_unknown_fields_of_a_newer_search_worker_are_ignored() -> None:
    reported = answer((1, 0.5)).model_dump(mode="json") | {"of_the_future": 1}
    assert ranked(SearchResponse.model_validate(reported)) == [(1, 0.5)]


def test_a_generation_is_available_once_every_shard_has_it() -> None:
    both, one = new_id(), new_id()
    lag = ReplicationLag(versions=1, seconds=2.0, answers=True)
    merged = merge_statuses(
        {
            Shard(0, 2): SearchStatus(
                rows=3, resident_bytes=30, versions={both: 7, one: 1}, missing=("chunks/a",)
            ),
            Shard(1, 2): SearchStatus(
                rows=4,
                resident_bytes=40,
                versions={both: 6},
                incomplete=(both,),
                missing=(),
                lags={both: lag},
            ),
        }
    )
    assert (merged.rows, merged.resident_bytes, merged.missing) == (7, 70, ("chunks/a",))
    assert merged.versions == {both: 6}
    assert merged.incomplete == (both,)
    assert merged.loaded == {}
    assert merged.lags == {both: lag}
