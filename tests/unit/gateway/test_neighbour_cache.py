"""The cache of the rankings of stored photos."""

from __future__ import annotations

from services.gateway.similarity import neighbours
from services.gateway.similarity.neighbours import NeighbourCache, Neighbours
from shared.evaluation.places.evidence import PhotoLocation, RankedPhoto
from shared.ids import new_id

FOUND: Neighbours = (RankedPhoto(0.9, PhotoLocation(45.0, 7.0, None), new_id()),)


class Searches:
    """Counts the searches; `is_complete` says whether all of the map was searched."""

    def __init__(self, *, is_complete: bool = True) -> None:
        self.count = 0
        self.is_complete = is_complete

    def __call__(self) -> tuple[Neighbours, bool]:
        self.count += 1
        return FOUND, self.is_complete


def test_a_photo_of_an_unchanged_map_is_searched_once() -> None:
    cache, searches = NeighbourCache(), Searches()
    assert [cache.get_or_search(("photo", 1), searches) for _ in range(3)] == [FOUND] * 3
    assert searches.count == 1


def test_a_new_version_of_the_map_is_searched_again() -> None:
    cache, searches = NeighbourCache(), Searches()
    for version in (1, 2):
        cache.get_or_search(("photo", version), searches)
    assert searches.count == 2


def test_a_ranking_that_lacks_a_part_of_the_map_is_not_cached() -> None:
    cache, searches = NeighbourCache(), Searches(is_complete=False)
    for _ in range(2):
        assert cache.get_or_search("photo", searches) == FOUND
    assert searches.count == 2


def test_the_least_recently_used_rankings_are_dropped() -> None:
    cache, searches = NeighbourCache(), Searches()
    for photo in range(neighbours.CACHED_RANKINGS + 1):
        cache.get_or_search(photo, searches)
    cache.get_or_search(0, searches)
    assert searches.count == neighbours.CACHED_RANKINGS + 2
