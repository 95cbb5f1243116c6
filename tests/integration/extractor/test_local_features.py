"""Local features of a map's photos: computed, copied, and missing where they can't be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from PIL import Image
from sqlalchemy import select

from services.extractor import model_registry, publish
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.generations import Generation
from shared.catalog.maps import Map, Matching
from shared.descriptors.extractor import Extractor
from shared.errors import Misconfigured
from shared.jobs import JobKind, JobState
from shared.jobs.model_changes import start_reindex
from shared.jobs.runner import reclaim_expired_leases
from shared.matching.features import LocalFeatures
from shared.matching.mutual_nearest import match_keypoints
from shared.storage.chunks import features_key
from shared.storage.feature_files import read_feature_index, read_feature_rows
from shared.storage.keys import query_features_key
from tests.integration.harness import Harness
from tests.support.catalog_rows import problem_of, read_job, set_columns
from tests.support.photos import encoded, photo_bytes, turned_photo

TO_GEM = {"vocabulary_id": None, "extractor": "test-tiny-vlad:aggregator=gem"}


def textured(number: int) -> Image.Image:
    """A photo full of corners: random blocks of 8 pixels."""
    blocks = np.random.default_rng(number).integers(0, 256, (38, 50, 3))
    return Image.fromarray(np.kron(blocks.astype(np.uint8), np.ones((8, 8, 1), np.uint8)))


def texture_bytes(number: int) -> bytes:
    return encoded(textured(number), "JPEG", quality=90)


def features_of(harness: Harness) -> dict[UUID, LocalFeatures | None]:
    """The features of each photo of the active generation, read by range; None without."""
    with harness.catalog.read() as session:
        located = session.execute(
            select(Descriptor.photo_id, Descriptor.row, Chunk.object_key, Chunk.features_model)
            .join(Chunk, Chunk.id == Descriptor.chunk_id)
            .where(Descriptor.generation_id == harness.active().id)
        ).all()
    found: dict[UUID, LocalFeatures | None] = {}
    for photo_id, row, object_key, model in located:
        rows: dict[int, bytes] = {}
        if model is not None:
            key = features_key(object_key)
            rows = read_feature_rows(
                harness.store, key, read_feature_index(harness.store, key), [row]
            )
        found[photo_id] = LocalFeatures.decode(rows[row]) if row in rows else None
    return found


def keypoints(harness: Harness) -> dict[UUID, int | None]:
    return {
        photo_id: None if features is None else len(features.descriptors)
        for photo_id, features in features_of(harness).items()
    }


def set_matching(harness: Harness, matching: Matching) -> None:
    with harness.catalog.write() as session:
        session.get_one(Map, harness.map_id).matching = matching


def decide(harness: Harness, *, uses_matches: bool) -> None:
    with harness.catalog.write() as session:
        session.get_one(Generation, harness.active().id).uses_matches = uses_matches


def add_features(harness: Harness) -> UUID:
    """What `PATCH /maps/NAME` with `matching: on` does to a map without features."""
    set_matching(harness, Matching.ON)
    with harness.catalog.write() as session:
        return start_reindex(session, harness.active()).id


@pytest.fixture
def harness(harness_of: Callable[[str], Harness]) -> Harness:
    return harness_of("test-tiny-avg")


def test_photos_get_features_in_pixels_of_the_upright_photo(harness: Harness) -> None:
    scene = textured(1)
    upright, _ = harness.upload_bytes(encoded(scene, "PNG"))
    turned, _ = harness.upload_bytes(turned_photo(scene, 6, "PNG"))
    harness.drain()
    found = features_of(harness)
    first, second = found[upright], found[turned]
    assert first is not None
    assert second is not None
    assert (second.width, second.height) == scene.size
    pairs = match_keypoints(first, second)
    assert len(pairs) > 100
    points = first.pixels()[pairs[:, 0]], second.pixels()[pairs[:, 1]]
    np.testing.assert_allclose(*points, atol=0.5)


@pytest.mark.parametrize("decided", [None, True, False])
@pytest.mark.parametrize("matching", Matching)
def test_features_of_photos_are_computed_as_the_map_says_and_as_an_evaluation_decided(
    harness: Harness, matching: Matching, decided: bool | None
) -> None:
    harness.upload_bytes(photo_bytes(1))
    harness.drain()
    if decided is not None:
        decide(harness, uses_matches=decided)
    set_matching(harness, matching)
    photo, _ = harness.upload_bytes(texture_bytes(2))
    harness.drain()
    expected = matching == Matching.ON or (matching == Matching.AUTO and decided is not False)
    assert (keypoints(harness)[photo] is not None) == expected


@pytest.mark.parametrize(
    ("matching", "uses_matches", "params", "expected"),
    [
        (Matching.AUTO, True, {}, True),
        (Matching.AUTO, False, {}, False),
        (Matching.AUTO, False, {"matches": 5}, True),
        (Matching.AUTO, False, {"rerank": 5}, True),
        (Matching.AUTO, False, {"explain": True}, True),
        (Matching.AUTO, True, {"matches": 0}, False),
        (Matching.AUTO, True, {"matches": 0, "explain": True}, False),
        (Matching.OFF, True, {"matches": 5}, False),
    ],
)
def test_query_gets_features_where_its_search_matches_it(
    harness: Harness, matching: Matching, uses_matches: bool, params: dict[str, Any], expected: bool
) -> None:
    harness.upload_bytes(photo_bytes(1))
    harness.drain()
    decide(harness, uses_matches=uses_matches)
    set_matching(harness, matching)
    job_id = harness.ask(texture_bytes(2))
    set_columns(harness.catalog, job_id, params={"filename": "x.jpg", "search_params": params})
    harness.drain()
    assert read_job(harness.catalog, job_id).state == JobState.SUCCEEDED
    key = query_features_key(job_id)
    assert (harness.store.head(key) is not None) == expected
    if expected:
        index = read_feature_index(harness.store, key)
        (row,) = read_feature_rows(harness.store, key, index, [0]).values()
        assert len(LocalFeatures.decode(row).descriptors) > 100


def test_on_gives_all_photos_features_and_copies_their_rows_without_describing_them(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_matching(harness, Matching.OFF)
    photos = [harness.upload_bytes(texture_bytes(number))[0] for number in range(6)]
    harness.drain()
    assert set(keypoints(harness).values()) == {None}
    rows, old = harness.rows(), harness.active().id

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a photo was described")

    monkeypatch.setattr(Extractor, "describe", refuse)
    searchable: list[int] = []
    job = harness.finish(add_features(harness), lambda: searchable.append(harness.searchable()))
    assert job.state == JobState.SUCCEEDED
    assert set(searchable) == {len(photos)}, "it answers meanwhile"
    assert harness.active().id != old
    assert all(count and count > 100 for count in keypoints(harness).values())
    assert harness.rows().keys() == rows.keys()
    for photo_id, row in harness.rows().items():
        np.testing.assert_array_equal(row, rows[photo_id])


def test_on_resumes_after_a_kill_with_what_is_missing(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_matching(harness, Matching.OFF)
    harness.upload_bytes(texture_bytes(1))
    harness.drain()
    job_id = add_features(harness)
    harness.drain()
    harness.advance()  # the photos are queued
    building = harness.building()
    assert building is not None
    reindexed = [job.id for job in harness.reindex_jobs(building.id)]

    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(publish, "lock_map", killed)
        with pytest.raises(KeyboardInterrupt):
            harness.drain()
    orphans = {key for key in harness.keys(f"chunks/{building.id}") if key.endswith(".features")}
    assert len(orphans) == 1
    for reindexed_id in reindexed:
        set_columns(harness.catalog, reindexed_id, lease_until=None)
    with harness.catalog.write() as session:
        reclaim_expired_leases(session, all_leases=True)
    assert harness.finish(job_id).state == JobState.SUCCEEDED
    assert all(keypoints(harness).values())


def test_photo_whose_original_is_lost_keeps_its_row_and_has_no_features(harness: Harness) -> None:
    set_matching(harness, Matching.OFF)
    lost, kept = (harness.upload_bytes(texture_bytes(number))[0] for number in range(2))
    harness.drain()
    for key in harness.keys("originals/"):
        if harness.store.get(key) == texture_bytes(0):
            harness.store.delete(key)
    assert harness.finish(add_features(harness)).state == JobState.SUCCEEDED
    found = keypoints(harness)
    assert found[lost] is None
    assert found[kept]


@pytest.mark.parametrize("change", ["pca", "extractor"])
def test_model_change_copies_the_features_of_the_active_generation(
    harness: Harness, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(6):
        harness.upload_bytes(texture_bytes(number))
    harness.drain()
    before = features_of(harness)
    detected: list[int] = []
    detector = harness.worker.context.models.detector()
    detect = detector.detect

    def count(*photo: Any) -> list[LocalFeatures]:
        detected.append(1)
        return detect(*photo)

    monkeypatch.setattr(detector, "detect", count)
    if change == "pca":
        job_id = harness.start(JobKind.PCA, pca=2)
    else:
        job_id = harness.start(JobKind.SWITCH, **TO_GEM)
    assert harness.finish(job_id).state == JobState.SUCCEEDED
    assert not detected
    after = features_of(harness)
    assert after.keys() == before.keys()
    for photo_id, features in before.items():
        copied = after[photo_id]
        assert features is not None
        assert copied is not None
        assert copied.encode() == features.encode()


def test_damaged_features_are_computed_again_by_a_model_change(harness: Harness) -> None:
    harness.upload_bytes(texture_bytes(1))
    harness.drain()
    (key,) = (key for key in harness.keys("chunks/") if key.endswith(".features"))
    data = harness.store.get(key)
    harness.store.put(key, data[:-7])
    job_id = harness.start(JobKind.SWITCH, **TO_GEM)
    assert harness.finish(job_id).state == JobState.SUCCEEDED
    assert all(keypoints(harness).values())


def test_generation_of_a_map_that_gains_nothing_by_matches_gets_no_features(
    harness: Harness,
) -> None:
    harness.upload_bytes(texture_bytes(1))
    harness.drain()
    decide(harness, uses_matches=False)
    job_id = harness.start(JobKind.SWITCH, **TO_GEM)
    assert harness.finish(job_id).state == JobState.SUCCEEDED
    assert harness.active().uses_matches is False
    assert set(keypoints(harness).values()) == {None}


def test_missing_weights_of_local_features_stop_photos_and_not_queries(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    harness.upload_bytes(photo_bytes(1))
    harness.drain()
    decide(harness, uses_matches=True)

    def miss(_: Any) -> None:
        raise Misconfigured("weights_missing", "There are none.")

    monkeypatch.setattr(model_registry, "load_detector", miss)
    query = harness.ask(texture_bytes(2))
    set_columns(harness.catalog, query, params={"filename": "x", "search_params": {}})
    _, job_id = harness.upload_bytes(texture_bytes(3))
    harness.drain()
    assert harness.job(query).state == JobState.SUCCEEDED
    job = harness.job(job_id)
    assert job.state == JobState.QUEUED
    assert problem_of(job)["code"] == "weights_missing"
    assert harness.worker.state()["errors"] == {"xfeat": "weights_missing"}
