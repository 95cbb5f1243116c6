"""What the extractors have done, as the catalog and the store tell it."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Collection
from uuid import UUID

from sqlalchemy import func, select

from shared.catalog.session import Catalog
from shared.jobs import Job, JobKind, JobState
from shared.jobs.table import UNFINISHED_STATES
from shared.objects import ObjectStore

POLL_SECONDS = 0.2
MANIFEST_SUFFIX = ".json"


def count_descriptions(store: ObjectStore) -> Counter[UUID]:
    """How often each photo was described.

    A worker writes its chunk, with a manifest that names the photos, before it asks whether it may
    commit: work that was done twice shows here although only one of the two was let in. That holds
    while the steward merges nothing (COMPACT_CHUNKS, SLOT_ROWS).
    """
    found: Counter[UUID] = Counter()
    for info in store.list("chunks/"):
        if info.key.endswith(MANIFEST_SUFFIX):
            found.update(UUID(name) for name in json.loads(store.get(info.key))["photo_ids"])
    return found


def wait_for_jobs(
    catalog: Catalog, seconds: float, on_left: Callable[[int], object] = lambda left: None
) -> None:
    """Until every photo that is stored is described. AssertionError when it takes longer, or when
    one fails."""
    deadline = time.monotonic() + seconds
    while True:
        with catalog.read() as session:
            counts: dict[str, int] = dict(
                session.execute(
                    select(Job.state, func.count())
                    .where(Job.kind == JobKind.INDEX)
                    .group_by(Job.state)
                ).all()
            )
        assert not counts.get(JobState.FAILED), f"{counts[JobState.FAILED]} photos have failed"
        left = sum(counts.get(state, 0) for state in UNFINISHED_STATES)
        on_left(left)
        if not left:
            return
        assert time.monotonic() < deadline, f"{left} photos wait after {seconds:g} s"
        time.sleep(POLL_SECONDS)


def load_jobs(catalog: Catalog, job_ids: Collection[UUID]) -> list[Job]:
    """These jobs, as they are now."""
    with catalog.read() as session:
        return list(session.scalars(select(Job).where(Job.id.in_(job_ids))))
