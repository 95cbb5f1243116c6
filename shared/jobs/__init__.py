"""The job queue: claims, leases, the job runner, state transitions and wakeups.

The `jobs` table is the queue and the only source of truth. A wakeup (`shared.jobs.wakeups`) only
makes a worker look at the table sooner.
"""

from shared.catalog.jobs import Job, JobKind, JobState, Priority
from shared.jobs.claim import claim_jobs, mark_started
from shared.jobs.leases import extend_lease, maintain_lease
from shared.jobs.runner import reclaim_expired_leases
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
