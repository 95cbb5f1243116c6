"""Matches photos by their local features, which are read from the object store by range.

Products of NumPy pair the keypoints (`shared.matching.mutual_nearest`), in a thread for each
candidate, and poselib verifies the pairs.
"""

from __future__ import annotations

import logging
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from operator import attrgetter
from typing import Any

from cachetools import LRUCache, cachedmethod

from shared.errors import NotFound
from shared.matching.features import MIN_SIDE, LocalFeatures
from shared.matching.mutual_nearest import match_keypoints
from shared.matching.verification import verify_matches
from shared.responses.similarity import PointPair
from shared.search_api.protocol import FeatureReference, MatchRequest, MatchResponse, PhotoMatches
from shared.storage import ObjectStore
from shared.storage.feature_files import FeatureIndex, read_feature_index
from shared.storage.keys import QUERIES

log = logging.getLogger(__name__)

CACHED_FEATURE_BYTES = 64_000_000  # 900 photos of 1,000 keypoints of XFeat
CACHED_INDEX_BYTES = 16_000_000  # of files with 2 million photos
MAX_THREADS = 4

ModelFeatures = tuple[str, LocalFeatures]
"""`Detector.model`, and the features that it computed"""


class PhotoMatcher:
    """Matches one photo with others; thread-safe."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._features: LRUCache[Any, ModelFeatures] = LRUCache(
            CACHED_FEATURE_BYTES, getsizeof=lambda found: 68 + found[1].descriptors.nbytes
        )
        self._indexes: LRUCache[Any, FeatureIndex] = LRUCache(
            CACHED_INDEX_BYTES, getsizeof=lambda index: index.offsets.nbytes
        )

    def match(self, request: MatchRequest) -> MatchResponse:
        """See `SearchBackend.match`; Unavailable while the object store can't be read."""
        query = self.read_features(request.query)
        size = None if query is None else (query[1].width, query[1].height)
        if query is None or not len(query[1].positions):
            none = (None,) * len(request.candidates)
            reason = unusable_query_reason(query)
            return MatchResponse(candidates=none, reason=reason, query_size=size)
        found = match_threads().map(
            lambda candidate: self._match_pair(query, candidate, request.with_pairs),
            request.candidates,
        )
        return MatchResponse(candidates=tuple(found), query_size=size)

    def _match_pair(
        self, query: ModelFeatures, candidate: FeatureReference, with_pairs: bool
    ) -> PhotoMatches | None:
        found = self.read_features(candidate)
        if found is None or found[0] != query[0]:
            return None
        first, second = query[1], found[1]
        matches = match_keypoints(first, second)
        is_inlier = verify_matches(
            first.working_pixels()[matches[:, 0]], second.working_pixels()[matches[:, 1]]
        )
        pairs: tuple[PointPair, ...] = ()
        if with_pairs:
            numbers = matches[is_inlier]
            of_query = first.pixels()[numbers[:, 0]].round(1).tolist()
            of_photo = second.pixels()[numbers[:, 1]].round(1).tolist()
            pairs = tuple(
                PointPair(query=one, photo=other)
                for one, other in zip(of_query, of_photo, strict=True)
            )
        return PhotoMatches(matches=len(matches), inliers=int(is_inlier.sum()), pairs=pairs)

    def read_features(self, reference: FeatureReference) -> ModelFeatures | None:
        """Return the features of a photo and their model; None if they are missing or damaged."""
        try:
            if reference.object_key.startswith(QUERIES):  # expires with its object
                return self._read_stored(reference)
            return self._read_cached(reference)
        except NotFound:
            return None
        except ValueError as error:
            log.warning("the local features in %s are damaged: %s", reference, error)
            return None

    @cachedmethod(attrgetter("_features"), lock=attrgetter("_lock"))
    def _read_cached(self, reference: FeatureReference) -> ModelFeatures:
        return self._read_stored(reference)

    def _read_stored(self, reference: FeatureReference) -> ModelFeatures:
        key, row = reference.object_key, reference.row
        index = self._read_index(key)
        begin, end = index.row_range(row)
        if begin == end:
            raise NotFound("no_features", f"Row {row} of {key} has no local features.")
        return index.model, LocalFeatures.decode(self._store.read_range(key, begin, end - begin))

    @cachedmethod(attrgetter("_indexes"), lock=attrgetter("_lock"))
    def _read_index(self, key: str) -> FeatureIndex:
        return read_feature_index(self._store, key)


def unusable_query_reason(query: ModelFeatures | None) -> str:
    """Return why a query that has no keypoints can't be compared with any photo."""
    if query is None:
        return "The query has no local features that can be read."
    if max(query[1].width, query[1].height) < MIN_SIDE:
        return f"The longer side of the query is shorter than {MIN_SIDE} pixels."
    return "The query has too little texture to find points in it."


@cache
def match_threads() -> ThreadPoolExecutor:
    """Return the threads that photos are read and matched in."""
    return ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_THREADS), "search-match")
