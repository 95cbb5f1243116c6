"""Jobs: what has to be done, who is doing it, and until when that is believed.

The `jobs` table is the queue. A hint (`shared.jobs.wakeups`) only wakes a worker sooner.
"""

from shared.catalog.jobs import Job, JobKind, JobState, Priority
from shared.jobs.claim import claim_jobs, mark_started
from shared.jobs.leases import extend_lease, maintain_lease, reclaim_expired_leases
from shared.jobs.wakeups import InProcessWakeups, Wakeups

__all__ = [
    "InProcessWakeups",
    "Job",
    "JobKind",
    "JobState",
    "Priority",
    "Wakeups",
    "claim_jobs",
    "extend_lease",
    "maintain_lease",
    "mark_started",
    "reclaim_expired_leases",
]
