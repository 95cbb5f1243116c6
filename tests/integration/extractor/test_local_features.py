"""Local features of a map's photos: computed, copied, and missing where they can't be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from PIL import Image
from sqlalchemy import select, update

from services.extractor import publish
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.generations import Generation
from shared.catalog.maps import Map, Matching
from shared.descriptors.extractor import Extractor
from shared.jobs import JobKind, JobState
from shared.jobs.model_changes import start_reindex
from shared.jobs.runner import reclaim_expired_leases
from shared.matching.features import LocalFeatures
from shared.matching.matchers import MutualNearest
from shared.matching.verification import verify_matches
from shared.storage.chunks import features_key
from shared.storage.feature_files import read_feature_index, read_feature_rows
from shared.storage.keys import query_features_key
from tests.integration.workplace import Workplace
from tests.support.catalog_rows import read_job, set_columns
from tests.support.photos import encoded, photo_bytes, turned_photo

pytestmark = pytest.mark.databases("sqlite")


def textured(number: int, size: tuple[int, int] = (400, 300)) -> Image.Image:
    """A photo full of corners: random blocks of 8 pixels."""
    width, height = size
    blocks = np.random.default_rng(number).integers(0, 256, (height // 8 + 1, width // 8 + 1, 3))
    large = np.kron(blocks.astype(np.uint8), np.ones((8, 8, 1), np.uint8))
    return Image.fromarray(large[:height, :width])


def texture_bytes(number: int) -> bytes:
    return encoded(textured(number), "JPEG", quality=90)


def features_of(workplace: Workplace) -> dict[UUID, LocalFeatures | None]:
    """The features of each photo of the active generation, read by range; None without."""
    with workplace.catalog.read() as session:
        located = session.execute(
            select(Descriptor.photo_id, Descriptor.row, Chunk.object_key, Chunk.features_model)
            .join(Chunk, Chunk.id == Descriptor.chunk_id)
            .where(Descriptor.generation_id == workplace.active().id)
        ).all()
    found: dict[UUID, LocalFeatures | None] = {}
    for photo_id, row, object_key, model in located:
        rows: dict[int, bytes] = {}
        if model is not None:
            key = features_key(object_key)
            rows = read_feature_rows(
                workplace.store, key, read_feature_index(workplace.store, key), [row]
            )
        found[photo_id] = LocalFeatures.decode(rows[row]) if row in rows else None
    return found


def keypoints(workplace: Workplace) -> dict[UUID, int | None]:
    return {
        photo_id: None if features is None else len(features.descriptors)
        for photo_id, features in features_of(workplace).items()
    }


def set_matching(workplace: Workplace, matching: Matching) -> None:
    with workplace.catalog.write() as session:
        session.get_one(Map, workplace.map_id).matching = matching


def decide(workplace: Workplace, *, uses_matches: bool) -> None:
    with workplace.catalog.write() as session:
        session.get_one(Generation, workplace.active().id).uses_matches = uses_matches


def add_features(workplace: Workplace) -> UUID:
    """What `PATCH /maps/NAME` with `matching: on` does to a map without features."""
    set_matching(workplace, Matching.ON)
    with workplace.catalog.write() as session:
        return start_reindex(session, workplace.active()).id


@pytest.fixture
def workplace(workplace_of: Callable[[str], Workplace]) -> Workplace:
    return workplace_of("test-tiny-avg")


def test_photos_get_features_in_pixels_of_the_upright_photo(workplace: Workplace) -> None:
    scene = textured(1)
    upright, _ = workplace.upload_bytes(encoded(scene, "PNG"))
    turned, _ = workplace.upload_bytes(turned_photo(scene, 6, "PNG"))
    workplace.drain()
    found = features_of(workplace)
    first, second = found[upright], found[turned]
    assert first is not None
    assert second is not None
    assert (second.width, second.height) == scene.size
    pairs = MutualNearest(0.9).match(first, second)
    assert len(pairs) > 100
    points = first.pixels()[pairs[:, 0]], second.pixels()[pairs[:, 1]]
    np.testing.assert_allclose(*points, atol=0.5)


def test_shifted_copy_of_a_photo_matches_it_and_another_photo_does_not(
    workplace: Workplace,
) -> None:
    scene = textured(1, (800, 600))
    views = [scene.crop((x, 0, x + 640, 600)) for x in (0, 80)]
    photos = [workplace.upload_bytes(encoded(view, "JPEG"))[0] for view in (*views, textured(2))]
    workplace.drain()
    found = features_of(workplace)

    def inliers(one: UUID, other: UUID) -> int:
        first, second = found[one], found[other]
        assert first is not None
        assert second is not None
        pairs = MutualNearest(0.82).match(first, second)
        points = first.working_pixels()[pairs[:, 0]], second.working_pixels()[pairs[:, 1]]
        return int(verify_matches(*points).sum())

    same_place = inliers(photos[0], photos[1])
    assert same_place > max(100, 4 * inliers(photos[0], photos[2]))


def test_photo_of_8_pixels_and_one_without_texture_have_features_without_keypoints(
    workplace: Workplace,
) -> None:
    tiny, _ = workplace.upload_bytes(encoded(Image.new("RGB", (8, 8), "red"), "PNG"))
    flat, _ = workplace.upload_bytes(encoded(Image.new("RGB", (640, 480), "grey"), "PNG"))
    workplace.drain()
    assert keypoints(workplace) == {tiny: 0, flat: 0}
    assert workplace.searchable() == 2


@pytest.mark.parametrize("decided", [None, True, False])
@pytest.mark.parametrize("matching", Matching)
def test_features_of_photos_are_computed_as_the_map_says_and_as_an_evaluation_decided(
    workplace: Workplace, matching: Matching, decided: bool | None
) -> None:
    workplace.upload_bytes(photo_bytes(1))
    workplace.drain()
    if decided is not None:
        decide(workplace, uses_matches=decided)
    set_matching(workplace, matching)
    photo, _ = workplace.upload_bytes(texture_bytes(2))
    workplace.drain()
    expected = matching == Matching.ON or (matching == Matching.AUTO and decided is not False)
    assert (keypoints(workplace)[photo] is not None) == expected


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
    workplace: Workplace,
    matching: Matching,
    uses_matches: bool,
    params: dict[str, Any],
    expected: bool,
) -> None:
    workplace.upload_bytes(photo_bytes(1))
    workplace.drain()
    decide(workplace, uses_matches=uses_matches)
    set_matching(workplace, matching)
    job_id = workplace.ask(texture_bytes(2))
    set_columns(workplace.catalog, job_id, params={"filename": "x.jpg", "search_params": params})
    workplace.drain()
    assert read_job(workplace.catalog, job_id).state == JobState.SUCCEEDED
    key = query_features_key(job_id)
    assert (workplace.store.head(key) is not None) == expected
    if expected:
        index = read_feature_index(workplace.store, key)
        (row,) = read_feature_rows(workplace.store, key, index, [0]).values()
        assert len(LocalFeatures.decode(row).descriptors) > 100


def test_on_gives_all_photos_features_and_copies_their_rows_without_describing_them(
    workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_matching(workplace, Matching.OFF)
    photos = [workplace.upload_bytes(texture_bytes(number))[0] for number in range(6)]
    workplace.drain()
    assert set(keypoints(workplace).values()) == {None}
    rows, old = workplace.rows(), workplace.active().id

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a photo was described")

    monkeypatch.setattr(Extractor, "describe", refuse)
    searchable: list[int] = []
    job = workplace.finish(
        add_features(workplace), lambda: searchable.append(workplace.searchable())
    )
    assert job.state == JobState.SUCCEEDED
    assert set(searchable) == {len(photos)}, "it answers meanwhile"
    assert workplace.active().id != old
    assert all(count and count > 100 for count in keypoints(workplace).values())
    assert workplace.rows().keys() == rows.keys()
    for photo_id, row in workplace.rows().items():
        np.testing.assert_array_equal(row, rows[photo_id])


def test_on_resumes_after_a_kill_with_what_is_missing(
    workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_matching(workplace, Matching.OFF)
    workplace.upload_bytes(texture_bytes(1))
    workplace.drain()
    job_id = add_features(workplace)
    workplace.drain()
    workplace.advance()  # the photos are queued
    building = workplace.building()
    assert building is not None
    reindexed = [job.id for job in workplace.reindex_jobs(building.id)]

    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(publish, "lock_map", killed)
        with pytest.raises(KeyboardInterrupt):
            workplace.drain()
    orphans = {key for key in workplace.keys(f"chunks/{building.id}") if key.endswith(".features")}
    assert len(orphans) == 1
    for reindexed_id in reindexed:
        set_columns(workplace.catalog, reindexed_id, lease_until=None)
    with workplace.catalog.write() as session:
        reclaim_expired_leases(session, all_leases=True)
    assert workplace.finish(job_id).state == JobState.SUCCEEDED
    assert all(keypoints(workplace).values())


def test_photo_whose_original_is_lost_keeps_its_row_and_has_no_features(
    workplace: Workplace,
) -> None:
    set_matching(workplace, Matching.OFF)
    lost, kept = (workplace.upload_bytes(texture_bytes(number))[0] for number in range(2))
    workplace.drain()
    for key in workplace.keys("originals/"):
        if workplace.store.get(key) == texture_bytes(0):
            workplace.store.delete(key)
    assert workplace.finish(add_features(workplace)).state == JobState.SUCCEEDED
    found = keypoints(workplace)
    assert found[lost] is None
    assert found[kept]


@pytest.mark.parametrize("change", ["pca", "extractor"])
def test_model_change_copies_the_features_of_the_active_generation(
    workplace: Workplace, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(6):
        workplace.upload_bytes(texture_bytes(number))
    workplace.drain()
    before = features_of(workplace)
    detected: list[int] = []
    detector = workplace.worker.context.models.detector("xfeat")
    detect = detector.detect

    def count(*photo: Any) -> LocalFeatures:
        detected.append(1)
        return detect(*photo)

    monkeypatch.setattr(detector, "detect", count)
    if change == "pca":
        job_id = workplace.start(JobKind.PCA, pca=2)
    else:
        job_id = workplace.start(
            JobKind.SWITCH, vocabulary_id=None, extractor="test-tiny-vlad:aggregator=gem"
        )
    assert workplace.finish(job_id).state == JobState.SUCCEEDED
    assert not detected
    after = features_of(workplace)
    assert after.keys() == before.keys()
    for photo_id, features in before.items():
        copied = after[photo_id]
        assert features is not None
        assert copied is not None
        assert copied.encode() == features.encode()


def test_damaged_features_are_computed_again_by_a_model_change(workplace: Workplace) -> None:
    workplace.upload_bytes(texture_bytes(1))
    workplace.drain()
    (key,) = (key for key in workplace.keys("chunks/") if key.endswith(".features"))
    data = workplace.store.get(key)
    workplace.store.put(key, data[:-7])
    job_id = workplace.start(
        JobKind.SWITCH, vocabulary_id=None, extractor="test-tiny-vlad:aggregator=gem"
    )
    assert workplace.finish(job_id).state == JobState.SUCCEEDED
    assert all(keypoints(workplace).values())


def test_generation_of_a_map_that_gains_nothing_by_matches_gets_no_features(
    workplace: Workplace,
) -> None:
    workplace.upload_bytes(texture_bytes(1))
    workplace.drain()
    decide(workplace, uses_matches=False)
    job_id = workplace.start(
        JobKind.SWITCH, vocabulary_id=None, extractor="test-tiny-vlad:aggregator=gem"
    )
    assert workplace.finish(job_id).state == JobState.SUCCEEDED
    assert workplace.active().uses_matches is False
    assert set(keypoints(workplace).values()) == {None}


def test_unknown_detector_of_a_map_stops_its_photos_and_not_its_queries(
    workplace: Workplace,
) -> None:
    workplace.upload_bytes(photo_bytes(1))
    workplace.drain()
    decide(workplace, uses_matches=True)
    with workplace.catalog.write() as session:
        session.execute(update(Chunk).values(features_model="retired@1"))
    query = workplace.ask(texture_bytes(2))
    set_columns(workplace.catalog, query, params={"filename": "x", "search_params": {}})
    _, job_id = workplace.upload_bytes(texture_bytes(3))
    workplace.drain()
    assert workplace.job(query).state == JobState.SUCCEEDED
    job = workplace.job(job_id)
    assert job.state == JobState.QUEUED
    assert job.error is not None
    assert job.error["code"] == "unknown_detector"
    assert workplace.worker.state()["errors"] == {"retired": "unknown_detector"}
