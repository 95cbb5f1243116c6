"""Jobs: what has to be done, who is doing it, and until when that is believed.

The `jobs` table is the queue. A hint (`shared.jobs.hints`) only wakes a worker sooner.
"""

from shared.jobs.claim import claim_jobs, mark_started
from shared.jobs.hints import InProcessWakeups, Wakeups
from shared.jobs.leases import extend_lease, maintain_lease, reclaim_expired_leases
from shared.jobs.table import Job, JobKind, JobState, Priority

__all__ = [
    "Wakeups",
    "InProcessWakeups",
    "Job",
    "JobKind",
    "JobState",
    "Priority",
    "mark_started",
    "claim_jobs",
    "extend_lease",
    "reclaim_expired_leases",
    "maintain_lease",
]
