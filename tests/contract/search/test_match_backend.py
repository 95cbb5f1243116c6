"""Matches of local features, by a worker in process and over HTTP."""

from __future__ import annotations

import httpx2
import numpy as np
import pytest

from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.errors import Unavailable
from shared.matching.features import LocalFeatures
from shared.search_api.protocol import FeatureReference, MatchRequest, SearchBackend
from shared.storage import FolderStore
from tests.support.local_features import SCENE_POINTS, SIZE, put_features, scene_features
from tests.support.search_tier import SearchTier

pytestmark = pytest.mark.databases("sqlite")


def test_photos_of_the_query_s_scene_have_inliers_and_pairs_in_pixels_of_the_originals(
    backend: SearchBackend, store: FolderStore
) -> None:
    (query,) = put_features(store, scene_features(1), key="queries/1.features")
    candidates = [
        *put_features(store, scene_features(2), scene_features(1, view=0.5)),
        *put_features(store, LocalFeatures.empty(SIZE, 64)),
    ]
    request = MatchRequest(query=query, candidates=tuple(candidates), with_pairs=True)
    for _ in range(2):  # the second time from memory
        other, same, plain = backend.match(request).candidates
        assert other is not None
        assert same is not None
        assert plain is not None
        assert same.matches == SCENE_POINTS
        assert same.inliers == len(same.pairs) > 0.9 * SCENE_POINTS
        for pair in same.pairs:
            # The camera moved to the right: every point moves to the left, the near ones farther.
            assert pair.query[1] == pytest.approx(pair.photo[1], abs=0.2)
            assert 0.5 * SIZE[0] / 8 < pair.query[0] - pair.photo[0] < 0.5 * SIZE[0] / 4
        assert other.inliers < 10
        assert (plain.matches, plain.inliers) == (0, 0)
    without = backend.match(request.model_copy(update={"with_pairs": False})).candidates
    assert [each and (each.inliers > 100, each.pairs) for each in without] == [
        (False, ()),
        (True, ()),
        (False, ()),
    ]


def test_photos_without_readable_features_of_the_query_s_model_are_left_out(
    backend: SearchBackend, store: FolderStore
) -> None:
    same, view = scene_features(1), scene_features(1, view=0.2)
    query, kept, empty, broken = put_features(store, same, view, None, view)
    whole = store.get(query.object_key)
    store.put(query.object_key, whole[:-1])
    (other_model,) = put_features(store, view, model="other@0123456789ab")
    (no_file,) = put_features(store, view)
    store.put(no_file.object_key, b"PWF1 and then something else")
    (huge_row,) = put_features(store, view)
    data = bytearray(store.get(huge_row.object_key))
    end_of_row = data.index(b"}") + 1 + 8
    data[end_of_row : end_of_row + 8] = np.array(1 << 60, "<u8").tobytes()
    store.put(huge_row.object_key, bytes(data))
    missing = FeatureReference(object_key="chunks/no/such.features", row=0)
    no_row = kept.model_copy(update={"row": 99})
    left_out = (empty, broken, other_model, no_file, huge_row, missing, no_row)
    answer = backend.match(MatchRequest(query=query, candidates=(*left_out, kept)))
    assert answer.candidates[:-1] == (None,) * len(left_out)
    assert answer.candidates[-1] is not None
    assert answer.reason is None


@pytest.mark.parametrize(
    ("query", "reason"),
    [
        (None, "no local features"),
        (LocalFeatures.empty(SIZE, 64), "too little texture"),
        (LocalFeatures.empty((8, 8), 64), "shorter than 240 pixels"),
    ],
)
def test_query_without_features_is_matched_with_nothing_and_the_reason_is_given(
    backend: SearchBackend, store: FolderStore, query: LocalFeatures | None, reason: str
) -> None:
    (reference,) = put_features(store, query, key="queries/1.features")
    candidates = put_features(store, scene_features(1), scene_features(2))
    answer = backend.match(MatchRequest(query=reference, candidates=tuple(candidates)))
    assert answer.candidates == (None, None)
    assert answer.reason is not None
    assert reason in answer.reason


def test_next_worker_matches_when_one_is_down_and_the_metrics_count_it(
    catalog: Catalog, store: FolderStore, settings: Settings
) -> None:
    query, *others = put_features(store, scene_features(1), scene_features(1, view=0.5), None)
    request = MatchRequest(query=query, candidates=tuple(others))
    with SearchTier(catalog, store, settings, 2) as tier:
        first, second = tier.servers
        second.stop()
        for _ in range(5):  # the order of the workers is random
            assert tier.port.match(request).candidates[0] is not None
        metrics = httpx2.get(f"{first.url}/metrics").text
        assert 'placewise_search_matches_total{outcome="answered"} 5.0' in metrics
        assert 'placewise_search_matched_photos_total{outcome="without_features"} 5.0' in metrics
        first.stop()
        with pytest.raises(Unavailable) as caught:
            tier.port.match(request)
        assert caught.value.code == "search_unavailable"
