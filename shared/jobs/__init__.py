"""The job queue: claims, leases, the job runner, state transitions and wakeups.

The `jobs` table is the queue and the only source of truth. A wakeup (`shared.jobs.wakeups`) only
makes a worker look at the table sooner.
"""

from shared.catalog.jobs import Job, JobKind, JobState, Priority
from shared.jobs.wakeups import InProcessWakeups, Wakeups

__all__ = ["InProcessWakeups", "Job", "JobKind", "JobState", "Priority", "Wakeups"]
