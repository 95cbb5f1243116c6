"""One id from a call through its jobs to a chunk: in answers, logs, the catalog, traces."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Iterator
from uuid import UUID

import pytest
from opentelemetry.sdk.trace import ReadableSpan
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from sqlalchemy import select

from services.steward.batches.worker import BatchWorker
from shared.catalog.batch_items import BatchItem
from shared.catalog.chunks import Chunk
from shared.catalog.jobs import Job, JobKind
from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.jobs import InProcessWakeups
from shared.telemetry.tracing import configure_tracing
from tests.integration.in_process_api import Service
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


def test_a_trace_leads_from_the_call_to_the_transaction_that_makes_it_searchable(
    service: Service,
) -> None:
    spans = InMemorySpanExporter()
    caller = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
    with configure_tracing(Settings(), "test", spans):
        answer = service(
            "POST",
            "/upload",
            files={"file": ("a.jpg", photo_bytes(1))},
            headers={"traceparent": caller, "X-Request-ID": ID},
        )
        service.upload(photo_bytes(2))
        service.drain()
        job_id = UUID(answer.json()["job_id"])
        with service.catalog.read() as session:
            stored = session.get_one(Job, job_id).traceparent
    done = {span.name: span for span in spans.get_finished_spans()}
    call = next(
        span
        for span in spans.get_finished_spans()
        if span.name == "POST /api/v1/upload" and _attribute(span, "request_id") == ID
    )
    assert f"{call.context.trace_id:032x}" == caller.split("-")[1]
    assert call.parent is not None
    assert f"{call.parent.span_id:016x}" == caller.split("-")[2]
    assert _attribute(call, "status") == 202
    assert stored == f"00-{call.context.trace_id:032x}-{call.context.span_id:016x}-01"
    for step in ("prepare", "describe", "publish"):
        # A batch of two requests' jobs: linked to both.
        assert call.context.span_id in {link.context.span_id for link in done[step].links}, step
        assert _attribute(done[step], "jobs") == 2
    assert service.upload(photo_bytes(3))["job_id"], "and without traces all goes on"


def test_traces_without_their_packages_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:4318")
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    with (
        pytest.raises(Misconfigured, match="extra `otel`") as caught,
        configure_tracing(Settings(), "gateway"),
    ):
        pass
    assert caught.value.code == "otel_missing"


def _attribute(span: ReadableSpan, name: str) -> object:
    return (span.attributes or {}).get(name)
