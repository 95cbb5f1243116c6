"""Maps that begin with GeM-pooled descriptors until they have a vocabulary."""

from __future__ import annotations

from uuid import UUID

import pytest
from sqlalchemy import select

from services.extractor.generation_resolver import reindex_outdated_generations
from shared.catalog.maps import Map
from shared.catalog.vocabularies import vocabulary_standing
from shared.jobs import Job, JobKind, JobState
from tests.integration.extractor.model_changes import import_file, npy, some_centres
from tests.integration.harness import Harness, expected_row, same
from tests.support.photos import photo_bytes

VLAD = "test-tiny-vlad"
POOLED = "test-tiny-vlad:aggregator=gem"


@pytest.fixture
def pooled(vlads: Harness) -> Harness:
    """A map of four photos, described before it has a vocabulary."""
    vlads.upload(*range(4))
    vlads.drain()
    return vlads


def extractors(harness: Harness) -> tuple[str, str, str]:
    """Extractor of the map, that of its active generation, and the standing of its vocabulary."""
    with harness.catalog.read() as session:
        generation = harness.active()
        map_ = session.get_one(Map, harness.map_id)
        return map_.extractor, generation.extractor, vocabulary_standing(session, generation)


def newest_job(harness: Harness, kind: JobKind) -> UUID | None:
    with harness.catalog.read() as session:
        of_kind = select(Job.id).where(Job.kind == kind).order_by(Job.id.desc())
        return session.scalars(of_kind.limit(1)).first()


def test_the_first_photo_is_described_by_pooling_the_same_local_features(
    pooled: Harness,
) -> None:
    assert extractors(pooled) == (VLAD, POOLED, "pending")
    assert pooled.searchable() == 4
    rows = pooled.rows()
    assert any(same(row, expected_row(POOLED, photo_bytes(2))) for row in rows.values())
    query = pooled.ask(photo_bytes(9))
    pooled.drain()
    assert pooled.job(query).state == JobState.SUCCEEDED


def test_an_imported_vocabulary_ends_the_pooling(pooled: Harness) -> None:
    job = import_file(pooled, npy(some_centres(1)))
    assert pooled.finish(job).state == JobState.SUCCEEDED
    assert extractors(pooled) == (VLAD, VLAD, "foreign")


def test_describing_the_photos_again_leaves_the_vocabulary_pending(
    pooled: Harness,
) -> None:
    generation = pooled.active()
    spec = {**generation.spec, "decoder": "of another release"}
    with pooled.catalog.write() as session:
        outdated = session.get_one(type(generation), generation.id)
        outdated.spec, outdated.spec_fingerprint = spec, "0" * 64
    started = reindex_outdated_generations(pooled.catalog, pooled.worker.context.models)
    assert started == 1
    switch = newest_job(pooled, JobKind.SWITCH)
    assert switch is not None
    assert pooled.finish(switch).state == JobState.SUCCEEDED
    assert pooled.active().id != generation.id
    assert extractors(pooled) == (VLAD, POOLED, "pending")


@pytest.mark.usefixtures("fit_at_four_photos")
def test_switching_to_the_pooling_extractor_by_name_is_no_waiting_for_a_vocabulary(
    pooled: Harness,
) -> None:
    job = pooled.start(JobKind.SWITCH, vocabulary_id=None, extractor=POOLED)
    assert pooled.finish(job).state == JobState.SUCCEEDED
    assert extractors(pooled) == (POOLED, POOLED, "none")
    assert pooled.fit_if_due() == []
