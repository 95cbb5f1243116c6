"""Retention: what expires, and what must not be deleted with it."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

import pytest
from sqlalchemy import select, update

from services.steward.tasks.maintenance import JOB_RETENTION_DAYS as DAYS
from services.steward.tasks.maintenance import delete_old_jobs, delete_old_searches
from shared.catalog.database.base import db_now_plus
from shared.catalog.database.session import Catalog
from shared.catalog.maps import Search, get_map
from shared.config.settings import Settings
from shared.jobs import Job, JobKind, JobState
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import add_job
from tests.support.photos import near_copy, photo_bytes
from tests.support.problems import problem

DAY_SECONDS = 86_400.0


def age_jobs(catalog: Catalog, days: float) -> None:
    """Everything that has ended ended so many days ago."""
    with catalog.write() as session:
        session.execute(
            update(Job)
            .where(Job.finished_at.is_not(None))
            .values(finished_at=db_now_plus(-days * DAY_SECONDS))
            .execution_options(synchronize_session=False)
        )


def jobs(catalog: Catalog) -> set[str]:
    with catalog.read() as session:
        return {str(job_id) for job_id in session.scalars(select(Job.id))}


def upload_again(service: Service, data: bytes) -> Any:
    answer = service("POST", "/upload", files={"file": data})
    assert answer.status_code in (200, 202), answer.text
    return answer.status_code, answer.json()


def test_jobs_that_ended_long_ago_are_deleted(service: Service, catalog: Catalog) -> None:
    done = service.upload(photo_bytes(1))["job_id"]
    response = service.ask(near_copy(1))
    service.drain()
    with catalog.write() as session:
        map_id = get_map(session, "default").id
        failed_fit = add_job(
            session, map_id, JobKind.FIT, state=JobState.FAILED, finished_at=db_now_plus(0)
        ).id
    age_jobs(catalog, DAYS - 0.01)
    delete_old_jobs(catalog)
    assert jobs(catalog) == {done, response, str(failed_fit)}
    age_jobs(catalog, DAYS + 0.01)
    recent = service.upload(photo_bytes(2))["job_id"]
    service.drain()
    waiting = service.upload(photo_bytes(3))["job_id"]
    delete_old_jobs(catalog)
    assert jobs(catalog) == {recent, waiting}
    problem(service("GET", f"/jobs/{done}"), 404, "job_not_found")


def test_the_ended_job_of_a_described_photo_is_deleted(service: Service, catalog: Catalog) -> None:
    first = service.upload(photo_bytes(1))
    service.drain()
    age_jobs(catalog, DAYS + 1)
    delete_old_jobs(catalog)
    assert jobs(catalog) == set()
    status, again = upload_again(service, photo_bytes(1))
    assert (status, again["file_id"], again["job_id"]) == (200, first["file_id"], None)
    assert again["status"] == "succeeded"
    assert service.json("GET", again["status_url"].removeprefix("/api/v1"))["searchable"]
    assert service.json("POST", f"/similarity/{first['file_id']}")["total_similar"] == 0
    assert service.json("DELETE", f"/uploads/{first['file_id']}")["success"]
    assert upload_again(service, photo_bytes(1))[0] == 202


@pytest.mark.parametrize("end", ["failed", "cancelled"])
def test_a_photo_that_was_not_described_keeps_its_job_and_can_be_queued_again(
    service: Service, catalog: Catalog, end: str
) -> None:
    data = photo_bytes(1)[:-60] if end == "failed" else photo_bytes(1)
    first = service.upload(data)
    if end == "cancelled":
        service.json("POST", f"/jobs/{first['job_id']}/cancel")
    service.drain()
    age_jobs(catalog, 10 * DAYS)
    delete_old_jobs(catalog)
    assert service.json("GET", f"/jobs/{first['job_id']}")["state"] == end
    status, again = upload_again(service, data)
    assert (status, again["job_id"], again["status"]) == (202, first["job_id"], "queued")
    service.drain()
    job = service.json("GET", f"/jobs/{first['job_id']}")
    assert job["state"] == ("failed" if end == "failed" else "succeeded")
    service.json("DELETE", f"/uploads/{first['file_id']}")


def test_searches_are_deleted_after_their_retention(service: Service, catalog: Catalog) -> None:
    (photo,) = service.indexed(1)
    for _ in range(2):
        service.json("POST", f"/similarity/{photo}")
    old, recent = (s["search_id"] for s in service.json("GET", "/searches")["searches"])
    with catalog.write() as session:
        session.get_one(Search, UUID(old)).searched_at = datetime.now(UTC) - timedelta(days=91)
        session.get_one(Search, UUID(recent)).searched_at = datetime.now(UTC) - timedelta(days=89)
    delete_old_searches(catalog, Settings())
    found = service.json("GET", "/searches")["searches"]
    assert [search["search_id"] for search in found] == [recent]
    assert service.json("GET", "/database/stats")["total_searches"] == 1
