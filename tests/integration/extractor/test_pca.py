"""PCA whitening of a map: from the request to shorter descriptors, and back."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any
from uuid import UUID

import numpy as np
import pytest
import torch

from services.extractor import describe, fits
from services.extractor.generation_resolver import reindex_outdated_generations
from services.extractor.model_registry import ModelRegistry
from services.steward.tasks import model_changes
from services.steward.tasks.garbage_collection import collect_whitenings
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.photos import Photo, PhotoRole
from shared.catalog.vocabularies import StoredWhitening
from shared.descriptors import extractor as extractor_module
from shared.descriptors.pca_fit import fit_pca as fit_whitening
from shared.descriptors.pca_whitening import PcaProjection, PcaWhitening, decode_whitening
from shared.descriptors.vocabulary import decode_centres
from shared.errors import NotFound
from shared.jobs import Job, JobKind, JobState
from shared.storage.chunks import Rows, decode_rows, read_row
from shared.storage.keys import WHITENINGS, query_vector_key
from tests.integration.conftest import LentDecoders
from tests.integration.harness import Harness, expected_row, same
from tests.support.catalog_rows import failure_code, result_of
from tests.support.checkpoints import none_added
from tests.support.photos import photo_bytes

pytestmark = pytest.mark.numerics

PHOTOS = 14
KEPT = 5
CPU = torch.device("cpu")


@pytest.fixture
def described(averages: Harness) -> Harness:
    """A map of PHOTOS photos with 16 dimensions."""
    averages.upload(*range(PHOTOS))
    averages.drain()
    return averages


@pytest.fixture
def reduced(described: Harness) -> Harness:
    """The same after PCA to KEPT dimensions."""
    reduce(described)
    return described


def reduce(harness: Harness) -> Job:
    job = harness.finish(harness.start(JobKind.PCA, pca=KEPT))
    assert job.state == JobState.SUCCEEDED, job.error
    return job


def by_hand(rows: dict[UUID, Rows]) -> PcaWhitening:
    """What a fit on all of these rows comes to."""
    return fit_whitening(np.stack([rows[photo_id] for photo_id in sorted(rows)]), KEPT)


def projected(whitening: PcaWhitening, row: Rows) -> Rows:
    found: Rows = PcaProjection(whitening, CPU).project(row[np.newaxis])[0]
    return found


def whitenings(harness: Harness) -> list[StoredWhitening]:
    with harness.catalog.read() as session:
        return list(session.query(StoredWhitening))


def forbid_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("a photo was decoded")

    monkeypatch.setattr(LentDecoders, "decode", refuse)


# --- the change ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "extractor",
    ["test-tiny-avg", "test-tiny-vlad", "test-tiny-vlad:aggregator=soft-vlad"],
)
def test_stored_rows_are_whitened_without_a_photo(
    harness_of: Callable[[str], Harness], extractor: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    harness = harness_of(extractor)
    harness.upload(*range(PHOTOS))
    harness.drain()
    if "vlad" in extractor:
        harness.fit(clusters=3)
    old, before = harness.active(), harness.rows()
    expected = by_hand(before)
    answering: list[tuple[UUID, int]] = []
    forbid_decoding(monkeypatch)

    job = harness.finish(
        harness.start(JobKind.PCA, pca=KEPT),
        lambda: answering.append((harness.active().id, harness.searchable())),
    )

    new = harness.active()
    assert {count for _, count in answering} == {PHOTOS}  # at no moment fewer
    assert [one for one, _ in itertools.groupby(a for a, _ in answering)] == [old.id, new.id]
    assert new.spec == {
        **old.spec,
        "dimension": KEPT,
        "whitening": {"sha256": expected.sha256, "from_dimension": old.dimension},
    }
    assert (new.dimension, new.pca_from, new.vocabulary_id) == (
        KEPT,
        old.dimension,
        old.vocabulary_id,
    )
    rows = harness.rows()
    assert rows.keys() == before.keys()
    for photo_id, row in rows.items():
        assert same(row, projected(expected, before[photo_id]))
        assert np.linalg.norm(row) == pytest.approx(1, abs=1e-5)
    assert result_of(job)["pca"] == {
        "from_dimension": old.dimension,
        "dimension": KEPT,
        "rows": PHOTOS,
        "explained": pytest.approx(expected.explained),
    }
    assert job.progress_done == job.progress_total == 2 * PHOTOS + fits.FIT_PROGRESS_UNITS
    (stored,) = whitenings(harness)
    file = decode_whitening(harness.store.get(stored.object_key))
    assert file.whitening.sha256 == stored.sha256 == expected.sha256
    assert file.spec == old.spec


def test_labelled_queries_are_projected_and_not_fitted_on(
    described: Harness,
) -> None:
    searched = sorted(described.rows())[:4]
    with described.catalog.write() as session:
        for photo_id in searched:
            session.get_one(Photo, photo_id).role = PhotoRole.QUERY
    before = described.rows()
    expected = by_hand({one: row for one, row in before.items() if one not in searched})
    assert expected.sha256 != by_hand(before).sha256

    reduce(described)

    assert whitenings(described)[0].sha256 == expected.sha256
    assert whitenings(described)[0].rows == PHOTOS - 4
    rows = described.rows()
    for photo_id in searched:
        assert same(rows[photo_id], projected(expected, before[photo_id]))


def test_queries_and_new_photos_are_projected(reduced: Harness) -> None:
    stored = whitenings(reduced)[0]
    whitening = decode_whitening(reduced.store.get(stored.object_key)).whitening
    data = photo_bytes(50)
    expected = projected(whitening, expected_row("test-tiny-avg", data))
    response, (photo_id, _) = reduced.ask(data), reduced.upload_bytes(data)
    reduced.drain()
    assert same(decode_rows(reduced.store.get(query_vector_key(response)))[0], expected)
    assert same(reduced.rows()[photo_id], expected)


@pytest.mark.parametrize("missing", [False, True])
def test_a_photo_with_a_damaged_row_is_described_from_its_original(
    described: Harness, monkeypatch: pytest.MonkeyPatch, missing: bool
) -> None:
    before = described.rows()
    expected, damaged = by_hand(before), before[sorted(before)[3]]

    def read(store: Any, key: str, row: int) -> Rows:
        found = read_row(store, key, row)
        if not np.array_equal(found, damaged):
            return found
        if missing:
            raise NotFound("object_not_found", "It is gone.")
        half: Rows = (found / 2).astype(np.float32)
        return half

    monkeypatch.setattr(fits, "read_chunk_row", read_row)  # the fit is not meant
    monkeypatch.setattr(describe, "read_row", read)
    reduce(described)
    for photo_id, row in described.rows().items():
        assert same(row, projected(expected, before[photo_id]))


def test_a_photo_whose_projected_row_is_not_finite_fails_alone(
    described: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = described.rows()
    refused = sorted(before)[3]
    real = PcaProjection.project

    def project(self: PcaProjection, rows: Rows) -> Rows:
        found = real(self, rows)
        found[(rows == before[refused]).all(axis=1)] = np.nan
        return found

    monkeypatch.setattr(PcaProjection, "project", project)
    monkeypatch.setattr(model_changes, "MAX_LOST_SHARE", 1 / PHOTOS)
    reduce(described)
    assert described.rows().keys() == before.keys() - {refused}
    with described.catalog.read() as session:
        (job,) = session.query(Job).filter_by(kind=JobKind.REINDEX, state=JobState.FAILED)
    assert (job.photo_id, failure_code(job)) == (refused, "features_not_finite")


def test_photos_are_described_where_the_rows_that_answer_were_made_otherwise(
    reduced: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An upgrade: the rows are projected ones, by a former decoder. The whitening stays."""
    before, old = reduced.rows(), reduced.active()
    monkeypatch.setattr(extractor_module, "DECODER", "another release")
    models = ModelRegistry(
        reduced.store, reduced.settings.model_copy(update={"device": "cpu"}), none_added
    )
    assert reindex_outdated_generations(reduced.catalog, models) == 1
    with reduced.catalog.read() as session:
        job_id = session.query(Job).filter_by(kind=JobKind.SWITCH).one().id
    assert reduced.finish(job_id).state == JobState.SUCCEEDED
    new = reduced.active()
    assert (new.id != old.id, new.whitening_id) == (True, old.whitening_id)
    assert new.spec == {**old.spec, "decoder": "another release"}
    assert all(same(row, before[photo_id]) for photo_id, row in reduced.rows().items())


# --- going on from there ---------------------------------------------------------------------


def test_switching_off_pca_describes_full_dimension_again(described: Harness) -> None:
    before, old = described.rows(), described.active()
    reduce(described)
    job = described.finish(described.start(JobKind.SWITCH, vocabulary_id=None))
    assert result_of(job)["pca"] is None
    assert described.active().spec == old.spec
    assert described.active().whitening_id is None
    assert all(same(row, before[photo_id]) for photo_id, row in described.rows().items())


def test_a_new_vocabulary_comes_without_pca(vlads: Harness) -> None:
    vlads.upload(*range(PHOTOS))
    vlads.fit(clusters=3)
    reduce(vlads)
    job = vlads.fit(clusters=4, seed=1)
    assert job.state == JobState.SUCCEEDED
    new = vlads.active()
    assert (new.dimension, new.pca_from, new.whitening_id) == (4 * 16, None, None)
    vocabulary = vlads.vocabulary(new.vocabulary_id)
    centres = decode_centres(vlads.store.get(vocabulary.object_key))
    rows = vlads.rows()
    first = sorted(rows)[0]
    assert same(rows[first], expected_row("test-tiny-vlad", photo_bytes(0), centres))


def test_a_pca_of_a_pca_is_refused(reduced: Harness) -> None:
    before = reduced.active().id
    assert failure_code(reduced.finish(reduced.start(JobKind.PCA, pca=3))) == "already_reduced"
    assert reduced.active().id == before


def test_a_pca_fit_on_too_few_photos_or_to_too_many_dimensions_fails(described: Harness) -> None:
    before = described.active().id
    for pca, code in ((PHOTOS, "pca_too_few_rows"), (17, "pca_too_many_dimensions")):
        assert failure_code(described.finish(described.start(JobKind.PCA, pca=pca))) == code
    assert described.active().id == before


def test_a_whitening_is_not_fitted_on_rows_of_another_release(
    described: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extractor_module, "DECODER", "another release")
    assert failure_code(described.finish(described.start(JobKind.PCA, pca=3))) == "spec_differs"


def test_a_map_without_descriptors_is_refused(averages: Harness) -> None:
    assert failure_code(averages.finish(averages.start(JobKind.PCA, pca=3))) == "nothing_described"


# --- what is left of it ----------------------------------------------------------------------


def test_a_whitening_is_deleted_after_its_last_generation(reduced: Harness) -> None:
    (stored,) = whitenings(reduced)
    collect_whitenings(reduced.catalog, reduced.store, grace_seconds=0)
    collect_orphans(reduced.catalog, reduced.store, age_seconds=-1)
    assert reduced.keys(WHITENINGS) == {stored.object_key}
    ended = reduced.active().id
    reduced.finish(reduced.start(JobKind.SWITCH, vocabulary_id=None))
    collect_whitenings(reduced.catalog, reduced.store, grace_seconds=60)
    assert reduced.keys(WHITENINGS) == {stored.object_key}, "the grace has not passed"
    collect_whitenings(reduced.catalog, reduced.store, grace_seconds=-1)
    assert (reduced.keys(WHITENINGS), whitenings(reduced)) == (set(), [])
    history = reduced.generation(ended)
    assert (history.whitening_id, history.pca_from) == (None, 16)
