"""One generation has rows of one precision, whatever PRECISION says and whatever the machine is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from uuid import UUID

import torch

from services.extractor.generation_resolver import reindex_outdated_generations
from services.extractor.worker import ExtractorWorker
from shared.catalog.generations import Generation
from shared.descriptors.extractor import Extractor
from shared.descriptors.inference import Precision
from shared.extractor_config.configs import get_extractor_config
from shared.imaging.decode import decode_photo
from shared.jobs import JobKind, JobState
from tests.integration.harness import Harness, same
from tests.support.catalog_rows import problem_of
from tests.support.photos import photo_bytes


def row(precision: Precision, number: int) -> Any:
    config = get_extractor_config("test-tiny-avg", allow_test_extractors=True)
    made = Extractor(config, torch.device("cpu"), precision=precision)
    pixels = decode_photo(photo_bytes(number), made.preprocessing, 10**9).pixels
    return made.describe([pixels], None)[0]


def precision_of(generation: Generation) -> str:
    found: str = generation.spec["precision"]
    return found


def test_changing_the_precision_setting_keeps_the_precision_of_existing_generations(
    averages: Harness, make_worker: Callable[..., ExtractorWorker]
) -> None:
    assert not same(row("float32", 2), row("bfloat16", 2)), "else this test could not fail"
    first = averages.upload(1)
    averages.drain()
    averages._worker = make_worker(precision="bfloat16")
    assert reindex_outdated_generations(averages.catalog, averages.worker.context.models) == 0
    second = averages.upload(2)
    query = averages.ask(photo_bytes(3))
    averages.drain()
    assert averages.job(query).state == JobState.SUCCEEDED
    assert precision_of(averages.active()) == "float32"
    rows = averages.rows()
    assert same(rows[first[0]], row("float32", 1))
    assert same(rows[second[0]], row("float32", 2))


def test_the_precision_setting_applies_to_new_maps(
    averages: Harness, make_worker: Callable[..., ExtractorWorker]
) -> None:
    averages._worker = make_worker(precision="bfloat16")
    (photo_id,) = averages.upload(2)
    averages.drain()
    assert precision_of(averages.active()) == "bfloat16"
    assert same(averages.rows()[photo_id], row("bfloat16", 2))


def test_a_model_change_applies_the_precision_setting(
    averages: Harness, make_worker: Callable[..., ExtractorWorker]
) -> None:
    photo_ids = averages.upload(1, 2, 3)
    averages.drain()
    averages._worker = make_worker(precision="bfloat16")
    job = averages.finish(averages.start(JobKind.SWITCH, vocabulary_id=None))
    assert job.state == JobState.SUCCEEDED
    assert precision_of(averages.active()) == "bfloat16"
    rows = averages.rows()
    for number, photo_id in enumerate(photo_ids, start=1):
        assert same(rows[photo_id], row("bfloat16", number))


def test_pca_keeps_the_precision_of_the_rows_that_it_shortens(
    averages: Harness, make_worker: Callable[..., ExtractorWorker]
) -> None:
    averages.upload(*range(6))
    averages.drain()
    whole = averages.active().spec
    averages._worker = make_worker(precision="bfloat16")
    job = averages.finish(averages.start(JobKind.PCA, pca=2))
    assert job.state == JobState.SUCCEEDED, job.error
    shortened = averages.active().spec
    assert (shortened["dimension"], shortened["precision"]) == (2, "float32")
    assert shortened.keys() - whole.keys() == {"whitening"}


def test_photos_wait_for_a_worker_that_knows_the_generations_precision(averages: Harness) -> None:
    averages.upload(1)
    averages.drain()
    _set_precision(averages, averages.active().id, "float8")
    (photo_id,) = averages.upload(2)
    averages.drain()
    job = averages.job_of(photo_id)
    assert (job.state, job.attempts) == (JobState.QUEUED, 0)
    assert problem_of(job)["code"] == "spec_differs"
    assert "float8" in problem_of(job)["detail"]


def _set_precision(place: Harness, generation_id: UUID, precision: str) -> None:
    with place.catalog.write() as session:
        generation = session.get_one(Generation, generation_id)
        generation.spec = {**generation.spec, "precision": precision}
