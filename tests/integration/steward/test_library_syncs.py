"""The schedule of the jobs that bring maps up to date with a photo library."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from services.steward.library_sync import repeat_library_syncs
from shared.catalog.database.session import Catalog
from shared.jobs import JobKind, JobState
from tests.support.catalog_rows import add_job, add_map, read_job


@pytest.mark.databases("sqlite", "postgresql")
@pytest.mark.parametrize(
    ("every_hours", "state", "hours_ago", "again"),
    [
        (24, JobState.SUCCEEDED, 25, True),
        (24, JobState.FAILED, 25, True),
        (24, JobState.SUCCEEDED, 23, False),
        (24, JobState.CANCELLED, 25, False),
        (None, JobState.SUCCEEDED, 25, False),
    ],
)
def test_a_job_is_queued_again_when_its_period_has_passed(
    catalog: Catalog, every_hours: int | None, state: JobState, hours_ago: int, again: bool
) -> None:
    columns: dict[str, Any] = {
        "params": {"every_hours": every_hours},
        "state": state,
        "result": {"indexed": 7},
        "finished_at": datetime.now(UTC) - timedelta(hours=hours_ago),
    }
    with catalog.write() as session:
        job_id = add_job(session, add_map(session).id, JobKind.SYNC_LIBRARY, **columns).id
    waits = repeat_library_syncs(catalog)
    job = read_job(catalog, job_id)
    assert (job.state == JobState.QUEUED) == again
    assert job.result == {"indexed": 7}, "the page shows the last counts meanwhile"
    assert waits == (every_hours is not None and state != JobState.CANCELLED)
    repeat_library_syncs(catalog)
    assert read_job(catalog, job_id).params == columns["params"]
