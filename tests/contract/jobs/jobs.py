"""Helpers of the tests of the job queue."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from shared.catalog.database.session import Catalog
from shared.errors import Unprocessable
from shared.jobs import Job
from shared.jobs.leases import lock_leased_jobs
from shared.jobs.runner import reclaim_expired_leases
from shared.jobs.transitions import succeed_job
from tests.support.catalog_rows import add_job

PROBLEM = Unprocessable("undecodable_photo", "The photo can't be decoded.").as_problem()


def queue(catalog: Catalog, map_id: UUID, count: int = 1, **columns: Any) -> list[UUID]:
    """Queue jobs; their ids, oldest first."""
    with catalog.write() as session:
        return [add_job(session, map_id, **columns).id for _ in range(count)]


def ids(jobs: list[Job]) -> list[UUID]:
    return [job.id for job in jobs]


def token_of(jobs: list[Job]) -> UUID:
    (token,) = {job.lease_token for job in jobs}
    assert token is not None
    return token


def end(catalog: Catalog, jobs: list[Job]) -> list[UUID]:
    """Finish what of the claimed jobs is still the worker's; the ids of those."""
    with catalog.write() as session:
        mine = lock_leased_jobs(session, token_of(jobs), jobs)
        for job in mine:
            succeed_job(job, {"done": True})
        return ids(mine)


def free(catalog: Catalog, **options: Any) -> int:
    with catalog.write() as session:
        return len(reclaim_expired_leases(session, **options))
