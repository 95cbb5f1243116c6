"""One id from a call through its jobs to a chunk: in answers, logs, the catalog and search."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator

import httpx2
import pytest
from opentelemetry.trace import NonRecordingSpan, SpanContext, TraceFlags, use_span
from sqlalchemy import select

from services.steward.batches.worker import BatchWorker
from shared.catalog.batch_items import BatchItem
from shared.catalog.chunks import Chunk
from shared.catalog.jobs import Job, JobKind
from shared.config.settings import Settings
from shared.jobs import InProcessWakeups
from shared.search_api.client import _call
from shared.telemetry.request_ids import request_id_context
from tests.integration.in_process_api import Service
from tests.support.fake_server import running_server
from tests.support.photos import photo_bytes

ID = "from-the-proxy-17"


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> Iterator[pytest.LogCaptureFixture]:
    with caplog.at_level(logging.DEBUG, "services"):
        yield caplog


def test_the_id_of_an_upload_is_found_in_the_answer_the_job_and_both_logs(
    service: Service, log: pytest.LogCaptureFixture
) -> None:
    answer = service(
        "POST",
        "/upload",
        files={"file": ("a.jpg", photo_bytes(1))},
        headers={"X-Request-ID": ID},
    )
    assert answer.headers["X-Request-ID"] == ID
    job_id = answer.json()["job_id"]
    service.upload(photo_bytes(2))
    service.drain()
    assert service.json("GET", f"/jobs/{job_id}")["request_id"] == ID

    (call,) = [line for line in log.records if line.getMessage() == "POST /api/v1/upload: 202"][:1]
    assert call.__dict__["route"] == "/api/v1/upload"
    assert call.__dict__["received_bytes"] > len(photo_bytes(1))
    (published,) = [line for line in log.records if line.name == "services.extractor.publish"]
    assert ID in published.__dict__["request_ids"]
    assert len(published.__dict__["request_ids"]) == 2, "the other call has an id of its own"
    assert job_id in published.__dict__["job_ids"]
    with service.catalog.read() as session:
        assert published.__dict__["chunk"] == session.scalars(select(Chunk.object_key)).one()


def test_photos_of_a_batch_carry_the_id_of_its_call(service: Service) -> None:
    service.json(
        "POST",
        "/upload/batch",
        202,
        files=[("file", (f"{number}.jpg", photo_bytes(number))) for number in (1, 2)],
        headers={"X-Request-ID": ID},
    )
    worker = BatchWorker(
        service.catalog, service.store, InProcessWakeups(), Settings(), "steward-test"
    )
    assert worker.run_next(threading.Event())
    with service.catalog.read() as session:
        assert len(session.scalars(select(BatchItem)).all()) == 2
        made = session.execute(select(Job.kind, Job.request_id)).all()
    assert sorted(made) == [(JobKind.BATCH, ID), (JobKind.INDEX, ID), (JobKind.INDEX, ID)]


def test_the_id_and_the_trace_of_a_call_go_on_to_search() -> None:
    caller = SpanContext(
        0x0AF7651916CD43DD8448EB211C80319C, 0xB7AD6B7169203331, False, TraceFlags(1)
    )
    with running_server() as server, httpx2.Client() as http:
        server.will_answer(200, {})
        with request_id_context(ID), use_span(NonRecordingSpan(caller)):
            _call(http, "GET", server.url, 30)
        (headers,) = server.headers
    assert headers["X-Request-ID"] == ID
    assert headers["traceparent"] == "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
