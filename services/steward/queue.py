"""The queue's duties: leases of dead workers come back, lost hints are sent again."""

from __future__ import annotations

import logging

from sqlalchemy import exists, select

from shared.catalog.session import Catalog
from shared.jobs import Wakeups, reclaim_expired_leases
from shared.jobs.hints import WakeupQueue
from shared.jobs.table import Job, Priority, claimable_condition

log = logging.getLogger(__name__)


def release_expired_leases(catalog: Catalog, max_attempts: int, *, all_leases: bool = False) -> int:
    """Give back what dead workers held; see `reclaim_expired_leases`."""
    with catalog.write() as session:
        freed = reclaim_expired_leases(session, max_attempts, all_leases=all_leases)
    if freed:
        log.warning("%d jobs were held by workers that died: given back", freed)
    return freed


def resend_hints(catalog: Catalog, hints: Wakeups) -> int:
    """Wake a worker when there is work: the hint that was sent with it may be lost. Returns how
    many hints were sent."""
    sent = 0
    with catalog.read() as session:
        for lane, condition in (
            (WakeupQueue.QUERY, Job.priority >= Priority.QUERY),
            (WakeupQueue.BULK, Job.priority < Priority.QUERY),
        ):
            if session.scalar(
                select(exists(select(Job.id).where(claimable_condition(), condition)))
            ):
                hints.send(lane)
                sent += 1
    return sent
