"""How long a slice of a model change is, and the steps of a fit that make one up."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Protocol

from services.extractor.new_generation import checkpoint_and_release
from shared.catalog.session import Catalog
from shared.jobs import Job
from shared.objects import ObjectStore
from shared.objects.keys import job_work_key

STEP_SECONDS = 1.0  # about the time of a batch: what a query may have to wait
FIT_PROGRESS_UNITS = 100  # of the job's progress: the steps of its fit, in per cent


class IncrementalFit(Protocol):
    """A fit that is done step by step, and saved between two of them."""

    @property
    def done(self) -> bool: ...

    @property
    def progress(self) -> tuple[int, int]:
        """Steps done, and all of them."""

    def save(self) -> bytes: ...

    def resume(self, data: bytes) -> None: ...


def time_slice() -> Iterator[None]:
    """Once, however slow the first round of the loop is, and again for about a second."""
    until = time.monotonic() + STEP_SECONDS
    while True:
        yield
        if time.monotonic() >= until:
            return


def run_fit_steps(
    catalog: Catalog,
    store: ObjectStore,
    job: Job,
    fit: IncrementalFit,
    step: Callable[[], object],
    *,
    resumed_param: str,
    progress_done: int,
) -> bool:
    """A slice of steps; True when the fit is done.

    Else it is saved and the job goes on. `resumed_param` is the parameter of the job that says that there
    is a saved one, `progress_done` the job's progress before the fit.
    """
    saved = job_work_key(job.id, "fit.npz")
    if job.params.get(resumed_param):
        fit.resume(store.get(saved))
    for _ in time_slice():
        if fit.done:
            break
        step()
    if fit.done:
        return True
    store.put(saved, fit.save())
    done, most = fit.progress
    checkpoint_and_release(
        catalog,
        job,
        params={**job.params, resumed_param: True},
        progress_done=progress_done + FIT_PROGRESS_UNITS * done // most,
    )
    return False
