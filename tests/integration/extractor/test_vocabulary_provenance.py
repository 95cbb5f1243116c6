"""What a map's vocabularies say of themselves, and which files it takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from shared.catalog.vocabularies import Vocabulary
from shared.descriptors.extractor import Extractor, choose_device
from shared.descriptors.vocabulary import encode_centres, parse_centres
from shared.descriptors.vocabulary_file import Provenance, feature_provenance
from shared.extractor_config.configs import get_extractor_config
from shared.imaging import preprocessing
from shared.jobs import JobKind, JobState
from tests.integration.extractor.model_changes import WIDTH, import_file
from tests.integration.harness import Harness
from tests.support.catalog_rows import failure_code, problem_of


def tiny_features() -> Provenance:
    config = get_extractor_config("test-tiny-vlad", allow_test_extractors=True)
    return feature_provenance(Extractor(config, choose_device("cpu")))


def active_vocabulary(harness: Harness) -> Vocabulary:
    return harness.vocabulary(harness.active().vocabulary_id)


def test_a_fitted_vocabulary_says_what_it_was_fitted_on(vlads: Harness) -> None:
    vlads.upload(*range(6))
    vlads.upload_bytes(b"nobody can decode this")
    assert vlads.fit(clusters=4, seed=5).state == JobState.SUCCEEDED
    found = active_vocabulary(vlads)
    cosine = found.provenance.pop("mean_cosine")
    passes = found.provenance.pop("passes")
    assert found.provenance == {
        **tiny_features(),
        "clusters": 4,
        "clusters_asked": 4,
        "photos": 6,
        "patches": 6 * 64,
        "seed": 5,
        "provisional": True,
        "sha256": found.sha256,
    }
    assert 0 < cosine < 1
    assert 10 < passes <= 20


def test_after_another_version_of_the_preprocessing_only_what_may_fit_is_switched_to(
    vlads: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    vlads.upload(*range(6))
    bare = encode_centres(parse_centres(np.eye(3, WIDTH, dtype=np.float32)))
    assert vlads.finish(import_file(vlads, bare, "bare.npy")).state == JobState.SUCCEEDED
    unknown = vlads.active().vocabulary_id
    assert vlads.fit().state == JobState.SUCCEEDED
    former = vlads.active()
    version_1 = former.spec["preprocessing"]
    version_2 = {**version_1, "version": version_1["version"] + 1}
    known = preprocessing.PREPROCESSINGS["square32"]
    monkeypatch.setitem(
        preprocessing.PREPROCESSINGS, "square32", replace(known, version=version_2["version"])
    )
    upgraded = replace(vlads, _worker=None)

    refused = upgraded.finish(
        upgraded.start(JobKind.SWITCH, vocabulary_id=str(former.vocabulary_id))
    )
    assert failure_code(refused) == "vocabulary_unusable"
    assert "square32 version 1; the extractor" in problem_of(refused)["detail"].replace("name ", "")
    assert problem_of(refused)["learnt_with"]["preprocessing"] == version_1
    assert problem_of(refused)["extractor_makes"]["preprocessing"] == version_2
    assert upgraded.active().id == former.id

    # Of unknown origin: that it belongs to the extractor was someone's word, and still is.
    taken = upgraded.finish(upgraded.start(JobKind.SWITCH, vocabulary_id=str(unknown)))
    assert taken.state == JobState.SUCCEEDED
    assert upgraded.active().spec["preprocessing"] == version_2
    assert upgraded.vocabulary(unknown).provenance["learnt_with"] == "unknown"

    assert upgraded.fit().state == JobState.SUCCEEDED
    assert upgraded.active().spec["preprocessing"] == version_2
    assert active_vocabulary(upgraded).provenance["preprocessing"] == version_2
    assert upgraded.vocabulary(former.vocabulary_id).provenance["preprocessing"] == version_1
