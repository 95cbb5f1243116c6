"""A vocabulary is used with the patch features that it was learnt from, or refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from shared.descriptors.extractor import Extractor, choose_device
from shared.descriptors.vocabulary import ClusterCentres, parse_centres
from shared.descriptors.vocabulary_file import (
    UNKNOWN_PROVENANCE,
    check_vocabulary_fits,
    feature_provenance,
)
from shared.errors import Unprocessable
from shared.extractor_config.configs import get_extractor_config


@pytest.fixture(scope="module")
def tiny() -> Extractor:
    return load("test-tiny-vlad")


def load(name: str) -> Extractor:
    return Extractor(get_extractor_config(name, allow_test_extractors=True), choose_device("cpu"))


def centres(width: int = 16) -> ClusterCentres:
    return parse_centres(np.random.default_rng(0).standard_normal((4, width)).astype(np.float32))


def refusal(provenance: dict[str, Any], extractor: Extractor, width: int = 16) -> Unprocessable:
    with pytest.raises(Unprocessable) as caught:
        check_vocabulary_fits(provenance, centres(width), extractor)
    assert caught.value.code == "vocabulary_unusable"
    return caught.value


def test_a_vocabulary_of_the_same_features_fits_with_any_other_metadata(tiny: Extractor) -> None:
    own = feature_provenance(tiny)
    assert own.items() <= tiny.spec(centres()).items()
    check_vocabulary_fits({**own, "photos": 3, "note": "mine"}, centres(), tiny)


@pytest.mark.parametrize(
    ("key", "other"),
    [
        ("backbone", "test-huge"),
        ("backbone_fingerprint", "cd" * 32),
        ("layer", "31"),
        ("facet", "value"),
        ("preprocessing", {"name": "square32", "version": 2}),
        ("preprocessing", None),
    ],
)
def test_a_vocabulary_of_other_features_is_refused_with_both_specs(
    tiny: Extractor, key: str, other: Any
) -> None:
    own = feature_provenance(tiny)
    error = refusal({**own, key: other}, tiny)
    assert error.extra == {"learnt_with": {**own, key: other}, "extractor_makes": own}
    reported = "version 2" if isinstance(other, dict) else str(other)[:12]
    assert reported in error.detail
    for part in ("test-tiny-vlad", "test-tiny (weights", "layer projection", "square32 version 1"):
        assert part in error.detail


def test_a_vocabulary_of_unknown_origin_only_has_to_be_as_wide(tiny: Extractor) -> None:
    check_vocabulary_fits(UNKNOWN_PROVENANCE, centres(), tiny)
    refused = refusal(UNKNOWN_PROVENANCE, tiny, width=15)
    assert "15 dimensions, the patch features of test-tiny-vlad 16" in refused.detail


def test_an_extractor_without_clusters_takes_no_vocabulary() -> None:
    average = load("test-tiny-avg")
    assert "uses no vocabulary" in refusal(feature_provenance(average), average).detail
