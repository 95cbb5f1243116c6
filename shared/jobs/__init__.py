"""Jobs: what has to be done, who is doing it, and until when that is believed.

The `jobs` table is the queue. A hint (`shared.jobs.hints`) only wakes a worker sooner.
"""

from shared.jobs.claim import begin, claim
from shared.jobs.hints import Hints, InProcessHints
from shared.jobs.leases import extend_lease, free_expired_leases, hold_lease
from shared.jobs.table import Job, JobKind, JobState, Priority

__all__ = [
    "Hints",
    "InProcessHints",
    "Job",
    "JobKind",
    "JobState",
    "Priority",
    "begin",
    "claim",
    "extend_lease",
    "free_expired_leases",
    "hold_lease",
]
