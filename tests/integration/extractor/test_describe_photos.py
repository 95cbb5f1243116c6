"""The extractor describes photos and queries, with real decoder processes."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import func, select

from services.extractor import fits
from services.extractor.worker import ExtractorWorker
from services.steward.tasks import auto_fit
from services.steward.tasks.auto_fit import fit_due_vocabularies
from shared.catalog.chunks import Chunk, list_live_chunks
from shared.catalog.generations import Generation
from shared.catalog.jobs import WaitingFor
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.descriptors.extractor import Extractor
from shared.descriptors.vocabulary import decode_centres
from shared.imaging.preprocessing import Pixels
from shared.jobs import JobKind, JobState
from shared.jobs.runner import IDLE_POLL_SECONDS
from shared.storage.chunks import decode_rows, manifest_key
from shared.storage.keys import query_vector_key, thumbnail_key
from tests.integration.extractor.conftest import Hook
from tests.integration.harness import Harness, expected_row, once, same
from tests.support.catalog_rows import problem_of, set_columns
from tests.support.photos import encoded, photo_bytes, photo_image
from tests.support.threads import at_once


def test_each_photo_has_one_descriptor_row_that_is_its_own(averages: Harness) -> None:
    photo_ids = averages.upload(*range(9))  # three batches
    averages.drain()
    assert averages.ended() == (9, 0)
    rows = averages.rows()
    assert set(rows) == set(photo_ids)
    for number, photo_id in enumerate(photo_ids):
        assert same(rows[photo_id], expected_row("test-tiny-avg", photo_bytes(number)))
        job = averages.job_of(photo_id)
        assert job.state == JobState.SUCCEEDED
        assert job.result == {
            "file_id": str(photo_id),
            "generation_id": str(averages.active().id),
        }
        assert averages.store.head(thumbnail_key(photo_id)) is not None
    with averages.catalog.read() as session:
        chunks = list_live_chunks(session, averages.active().id)
        assert [chunk.rows for chunk in chunks] == [4, 4, 1]
        # The first generation, then three batches: each is something new to find.
        assert session.get_one(Map, averages.map_id).version == 4
    for chunk in chunks:
        manifest = json.loads(averages.store.get(manifest_key(chunk.object_key)))
        assert manifest["sha256"] == chunk.sha256
        assert manifest["spec"] == averages.active().spec
    assert not averages.drain()


def test_a_query_in_an_empty_map_leaves_its_row_beside_its_bytes_and_none_in_the_map(
    averages: Harness,
) -> None:
    data = photo_bytes(2)
    job_id = averages.ask(data)
    assert averages.drain()
    reference = {
        "generation_id": str(averages.active().id),
        "object_key": query_vector_key(job_id),
        "row": 0,
    }
    assert averages.job(job_id).result == reference
    rows = decode_rows(averages.store.get(query_vector_key(job_id)))
    assert rows.shape == (1, 16)
    assert same(rows[0], expected_row("test-tiny-avg", data))
    assert averages.active().dimension == 16
    assert averages.rows() == {}


def test_an_undecodable_photo_fails_without_the_others_of_its_batch(averages: Harness) -> None:
    good = averages.upload(1, 2)
    _, undecodable = averages.upload_bytes(b"\xff\xd8\xff\xe0 this is no JPEG")
    lost_photo, lost = averages.upload_bytes(photo_bytes(4))
    query = averages.ask(photo_bytes(5)[:500])
    with averages.catalog.read() as session:
        averages.store.delete(session.get_one(Photo, lost_photo).object_key)
    averages.drain()
    assert averages.ended() == (2, 3)
    assert set(averages.rows()) == set(good)
    for job_id, code in (
        (undecodable, "undecodable_photo"),
        (lost, "object_not_found"),
        (query, "undecodable_photo"),
    ):
        job = averages.job(job_id)
        assert (job.state, job.progress_failed) == (JobState.FAILED, 1)
        assert problem_of(job)["code"] == code
        assert problem_of(job)["detail"]


@pytest.mark.databases("sqlite", "postgresql")
def test_two_workers_at_once_describe_each_photo_once(
    averages: Harness, make_worker: Callable[[], ExtractorWorker]
) -> None:
    photo_ids = averages.upload(*range(16))
    workers = [make_worker(), make_worker()]
    at_once(*(partial(worker.drain, threading.Event()) for worker in workers))
    assert set(averages.rows()) == set(photo_ids)
    with averages.catalog.read() as session:
        assert session.scalar(select(func.sum(Chunk.rows))) == 16
        assert session.scalar(select(func.count()).select_from(Generation)) == 1


@pytest.mark.databases("sqlite", "postgresql")
def test_two_workers_create_one_first_generation_of_a_map(
    averages: Harness, make_worker: Callable[[], ExtractorWorker], monkeypatch: pytest.MonkeyPatch
) -> None:
    (other,) = averages.upload(1)
    first, second = make_worker(), make_worker()
    query = averages.ask(photo_bytes(2))
    # While the first one is about to make the generation, the second one does.
    real = Extractor.shipped_vocabulary
    meanwhile = once(lambda: _drain(second))

    def shipped(self: Extractor) -> Any:
        meanwhile()
        return real(self)

    monkeypatch.setattr(Extractor, "shipped_vocabulary", shipped)
    _drain(first)
    assert set(averages.rows()) == {other}
    assert averages.job(query).state == JobState.SUCCEEDED
    with averages.catalog.read() as session:
        assert session.scalar(select(func.count()).select_from(Generation)) == 1


def _drain(worker: ExtractorWorker) -> None:
    worker.drain(threading.Event())


def test_photos_of_different_sizes_are_described_in_one_batch(
    harness_of: Callable[[str], Harness],
) -> None:
    extractor = "test-tiny-vlad:aggregator=gem,preprocessing=demo1024"
    place = harness_of(extractor)
    sizes = [(64, 48), (48, 64), (1500, 900), (64, 48), (10, 10)]
    photos = [encoded(photo_image(n, *size), "PNG") for n, size in enumerate(sizes)]
    photo_ids = [place.upload_bytes(photo)[0] for photo in photos]
    place.drain()
    assert place.ended() == (4, 1)
    rows = place.rows()
    for photo, photo_id in zip(photos[:4], photo_ids[:4], strict=True):
        assert same(rows[photo_id], expected_row(extractor, photo))
    too_small = place.job_of(photo_ids[4])
    assert problem_of(too_small)["code"] == "photo_too_small"
    spec = place.active().spec
    assert spec["preprocessing"] == {"name": "demo1024", "version": 1}
    assert (spec["aggregator"], spec["dimension"]) == ("gem", 16)


def test_vocabulary_is_fitted_on_photos_of_different_sizes(
    harness_of: Callable[[str], Harness],
) -> None:
    place = harness_of("test-tiny-vlad:aggregator=soft-vlad,clusters=2,preprocessing=round14")
    for number, size in enumerate([(64, 48), (48, 64), (90, 90)]):
        place.upload_bytes(encoded(photo_image(number, *size), "PNG"))
    place.fit(clusters=2)
    generation = place.active()
    assert (generation.dimension, generation.spec["temperature"]) == (32, 1.0)
    assert len(place.rows()) == 3


def test_a_query_does_not_wait_for_the_batch_that_is_being_described(
    averages: Harness, before_describing: Hook
) -> None:
    averages.upload(0)
    averages.drain()
    averages.upload(*range(1, 5))
    answered: list[JobState] = []

    def ask_and_wait(pixels: list[Pixels]) -> None:
        if len(pixels) > 1:  # the bulk batch, which goes on only when the query is answered
            job_id = averages.ask(photo_bytes(99))
            answered.append(averages.await_end(job_id))

    before_describing(ask_and_wait)
    averages.drain()
    assert answered == [JobState.SUCCEEDED]
    assert len(averages.rows()) == 5


def test_no_query_is_described_beside_a_job_marked_alone(
    averages: Harness, before_describing: Hook
) -> None:
    photo_id, job_id = averages.upload_bytes(photo_bytes(0))
    set_columns(averages.catalog, job_id, alone=True)
    during: list[JobState] = []
    queries: list[UUID] = []

    def ask(_: NDArray[np.uint8]) -> None:
        if not queries:
            queries.append(averages.ask(photo_bytes(99)))
            time.sleep(2 * IDLE_POLL_SECONDS)
            during.append(JobState(averages.job(queries[0]).state))

    before_describing(ask)
    averages.drain()
    assert during == [JobState.QUEUED]
    assert averages.job(queries[0]).state == JobState.SUCCEEDED
    assert set(averages.rows()) == {photo_id}


def test_queries_and_photos_are_described_while_a_vocabulary_is_fitted(
    vlads: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    vlads.upload(*range(8))
    vlads.fit()
    job_id = vlads.start(JobKind.FIT, clusters=8, sample=100, seed=1)
    seen: list[JobState] = []
    real = fits.compute_fit

    def describe_meanwhile(*arguments: Any) -> Any:
        query, photo = vlads.ask(photo_bytes(50)), vlads.upload(51)[0]
        vlads.worker.drain(threading.Event())
        seen.extend(JobState(job.state) for job in (vlads.job(query), vlads.job_of(photo)))
        return real(*arguments)

    monkeypatch.setattr(fits, "compute_fit", describe_meanwhile)
    vlads.drain()
    assert seen == [JobState.SUCCEEDED] * 2
    assert vlads.job(job_id).waiting_for == WaitingFor.DESCRIPTORS


@pytest.mark.usefixtures("fit_at_four_photos")
def test_a_vocabulary_is_fitted_once_there_are_enough_photos(vlads: Harness) -> None:
    photo_ids = vlads.upload(1, 2, 3)
    vlads.drain()
    assert vlads.fit_if_due() == []
    assert not vlads.wakeups.wait(0)
    photo_ids += vlads.upload(4)
    vlads.drain()
    vlads.fit_if_due()
    assert vlads.wakeups.wait(0)
    (job_id,) = vlads.fit_if_due()  # once is enough
    fit = vlads.finish(job_id)
    assert fit.state == JobState.SUCCEEDED
    assert fit.result is not None
    assert (fit.result["photos"], fit.result["failed"]) == (4, 0)
    generation = vlads.active()
    vocabulary = vlads.vocabulary(generation.vocabulary_id)
    centres = decode_centres(vlads.store.get(vocabulary.object_key))
    rows = vlads.rows()
    assert set(rows) == set(photo_ids)
    for number, photo_id in enumerate(photo_ids, start=1):
        assert same(rows[photo_id], expected_row("test-tiny-vlad", photo_bytes(number), centres))
        assert vlads.job_of(photo_id).state == JobState.SUCCEEDED
    query = vlads.ask(photo_bytes(9))
    vlads.drain()
    assert vlads.job(query).state == JobState.SUCCEEDED


@pytest.mark.usefixtures("fit_at_four_photos")
def test_a_vocabulary_is_fitted_again_when_the_map_has_doubled_also_after_a_cancelled_fit(
    vlads: Harness,
) -> None:
    vlads.upload(*range(4))
    vlads.drain()
    (first,) = vlads.fit_if_due()
    vlads.cancel(first)
    vlads.upload(*range(4, 7))
    vlads.drain()
    assert vlads.fit_if_due() == [first]
    vlads.upload(7)
    vlads.drain()
    _, second = vlads.fit_if_due()
    assert vlads.finish(second).state == JobState.SUCCEEDED
    vlads.upload(*range(8, 15))
    vlads.drain()
    assert vlads.fit_if_due() == [first, second]
    vlads.upload(15)
    vlads.drain()
    *_, third = vlads.fit_if_due()
    assert vlads.finish(third).state == JobState.SUCCEEDED
    assert vlads.fit_if_due() == [first, second, third]
    assert vlads.searchable() == 16


@pytest.mark.usefixtures("fit_at_four_photos")
def test_a_fit_waits_for_the_end_of_an_upload_unless_the_map_is_overdue(
    vlads: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    vlads.upload(*range(4))
    assert vlads.fit_if_due() == [], "photos are queued"
    vlads.drain()
    monkeypatch.setattr(auto_fit, "QUIET_SECONDS", 3600.0)
    assert fit_due_vocabularies(vlads.catalog, vlads.wakeups), "it is due in a while"
    vlads.upload(*range(4, 15))
    vlads.drain()
    assert vlads.fit_if_due() == []
    vlads.upload(15)
    vlads.drain()
    assert len(vlads.fit_if_due()) == 1
    assert not fit_due_vocabularies(vlads.catalog, vlads.wakeups)


@pytest.mark.usefixtures("fit_at_four_photos")
def test_no_vocabulary_is_fitted_where_it_is_switched_off_or_none_is_used(
    vlads: Harness, averages: Harness
) -> None:
    for place in (vlads, averages):
        place.upload(*range(4))
        place.drain()
    with vlads.catalog.write() as session:
        session.get_one(Map, vlads.map_id).auto_fit = False
    assert vlads.fit_if_due() == averages.fit_if_due() == []
    with vlads.catalog.write() as session:
        session.get_one(Map, vlads.map_id).auto_fit = True
    assert len(vlads.fit_if_due()) == 1
