"""Admission from several threads at once; what is refused is in `integration/gateway`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from services.gateway import admission as admission_module
from services.gateway.admission import AdmissionControl
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.errors import TooManyRequests
from shared.jobs.queue_depth import QueueDepth
from tests.support.threads import at_once

LIMIT, THREADS = 2000, 4


@pytest.fixture
def switching_often() -> Iterator[None]:
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.usefixtures("switching_often")
def test_concurrent_uploads_into_many_maps_are_admitted_up_to_the_limit_exactly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        admission_module, "measure_queue_depth", lambda *_: QueueDepth({}, 0, finished=0)
    )
    monkeypatch.setattr(admission_module, "ADMISSION_POLL_SECONDS", 3600.0)
    settings = Settings(placewise_home=tmp_path, min_free_bytes=0, max_queued_jobs=LIMIT)
    admission = AdmissionControl(Catalog("sqlite://"), settings)

    def admit(thread: int) -> int:
        for number in range(LIMIT):
            try:
                admission.admit_job(f"map-{thread}-{number}")
            except TooManyRequests:
                return number
        return LIMIT

    assert sum(at_once(*(partial(admit, thread) for thread in range(THREADS)))) == LIMIT
