"""One look at the job table for all requests that wait for a job's end.

Requests that each looked for themselves would have to look rarely; this one may look often, so that
an answer does not lie there for long.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from uuid import UUID

from sqlalchemy import select
from starlette.concurrency import run_in_threadpool

from shared.catalog.session import Catalog
from shared.jobs import Job
from shared.jobs.table import UNFINISHED

LOOK_SECONDS = 0.02
# Of a server that stops: most queries end within it, and the others still get an answer.
LAST_SECONDS = 5.0


class JobWatch:
    """Used from one event loop; looks only while someone waits."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._awaited: Counter[UUID] = Counter()
        self._look: asyncio.Future[set[UUID]] | None = None
        self._last_moment = math.inf

    def end_soon(self) -> None:
        """The server stops: nobody waits for longer than LAST_SECONDS from now."""
        self._last_moment = time.monotonic() + LAST_SECONDS

    async def wait_for_end(self, job_id: UUID, seconds: float) -> None:
        """Returns when the job has ended or is gone, at the latest after so many seconds.

        Raises what the catalog raises while it is away.
        """
        deadline = time.monotonic() + seconds
        self._awaited[job_id] += 1
        try:
            while (left := min(deadline, self._last_moment) - time.monotonic()) > 0:
                await asyncio.sleep(min(LOOK_SECONDS, left))
                if job_id in await self._ended():
                    return
        finally:
            self._awaited[job_id] -= 1
            self._awaited += Counter()  # forgets those that nobody awaits any more

    async def _ended(self) -> set[UUID]:
        """Those of the awaited jobs that have ended; who asks meanwhile shares the answer."""
        if self._look is None:
            self._look = asyncio.ensure_future(
                run_in_threadpool(_ended, self._catalog, set(self._awaited))
            )
            self._look.add_done_callback(self._looked)
        # Who goes away while waiting must not take the others' answer along.
        return await asyncio.shield(self._look)

    def _looked(self, look: asyncio.Future[set[UUID]]) -> None:
        self._look = None
        if not look.cancelled():
            look.exception()  # seen, also where nobody waits for it any more


def _ended(catalog: Catalog, job_ids: set[UUID]) -> set[UUID]:
    """Those of the jobs that have ended, or are gone."""
    with catalog.read() as session:
        unfinished = session.scalars(
            select(Job.id).where(Job.id.in_(job_ids), Job.state.in_(UNFINISHED))
        )
        return job_ids - set(unfinished)
