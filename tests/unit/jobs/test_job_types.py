"""The registry of job kinds: how each is shown, and what runs it."""

from __future__ import annotations

import services.extractor.worker  # noqa: F401  (imports the modules that register handlers)
from services.extractor.fits import FitWorker
from services.extractor.handlers import HANDLERS
from shared.catalog.jobs import DRAINED_JOBS, FIT_WORKER_JOBS, JOB_TYPES, STATUS_PAGE_JOBS, JobKind


def test_every_kind_of_job_has_a_type() -> None:
    assert set(JOB_TYPES) == set(JobKind)


def test_every_kind_of_the_extractor_has_a_handler() -> None:
    assert set(HANDLERS) == set(DRAINED_JOBS)
    assert set(FitWorker.HANDLERS) == set(FIT_WORKER_JOBS)


def test_the_status_page_lists_all_kinds_but_photos_for_a_new_model_and_query_photos() -> None:
    assert set(JobKind) - set(STATUS_PAGE_JOBS) == {JobKind.REINDEX, JobKind.DESCRIBE}
