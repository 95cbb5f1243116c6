"""Runs `placewise immich` as a job, and again on a schedule.

The command is a child process, because it calls the gateway as any client does. It takes the
addresses and keys from the environment of the steward, so that no key is stored.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import select

from services.steward.metrics import StewardMetrics
from services.steward.periodic_tasks import periodic_task
from shared.catalog.database.session import Catalog
from shared.catalog.maps import Map
from shared.config.settings import Settings
from shared.errors import Unprocessable
from shared.jobs import Job, JobKind, JobState
from shared.jobs.leases import lock_leased_job
from shared.jobs.progress import JobProgress
from shared.jobs.runner import JobRunner
from shared.jobs.transitions import requeue_job_as_new, succeed_job

COMMAND = (sys.executable, "-c", "from services.cli.main import run; run()", "immich", "--json")
POLL_SECONDS = 0.5


class LibrarySyncWorker:
    """Runs the jobs of libraries one after the other."""

    def __init__(
        self, catalog: Catalog, settings: Settings, name: str, metrics: StewardMetrics
    ) -> None:
        self._catalog = catalog
        self._home = settings.placewise_home
        kinds = (JobKind.SYNC_LIBRARY,)
        self._runner = JobRunner(catalog, settings, name, kinds, metrics.count_jobs)

    def run(self, stop: threading.Event) -> None:
        """Run jobs until `stop` is set."""
        self._runner.run_jobs(lambda job: self._run_job(job, stop), stop)

    def _run_job(self, job: Job, stop: threading.Event) -> None:
        with self._catalog.read() as session:
            map_name = session.get_one(Map, job.map_id).name
        result = self._sync(map_name, JobProgress(self._catalog, job, stop))
        result["every_hours"] = job.params["every_hours"]
        with self._catalog.write() as session:
            leased = lock_leased_job(session, job)
            if leased is not None:
                succeed_job(leased, result)

    def _sync(self, map_name: str, progress: JobProgress) -> dict[str, Any]:
        environment = {**os.environ, "PLACEWISE_HOME": str(self._home.absolute())}
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as log:
            command = [*COMMAND, f"--map={map_name}"]
            with subprocess.Popen(  # noqa: S603 the program is Placewise
                command, env=environment, stdout=out, stderr=log
            ) as process:
                try:
                    while process.poll() is None:
                        progress.check()
                        with contextlib.suppress(subprocess.TimeoutExpired):
                            process.wait(POLL_SECONDS)
                finally:
                    process.kill()
            out.seek(0)
            log.seek(0)
            return _read_report(out.read(), log.read())


def _read_report(output: bytes, log: bytes) -> dict[str, Any]:
    """Return the counts that the command has printed; raises its error."""
    try:
        report = json.loads(output)
    except ValueError as error:
        last = log.decode(errors="replace").strip().rpartition("\n")[2]
        raise Unprocessable("library_sync_failed", f"`placewise immich` ended: {last}") from error
    if "code" in report:
        raise Unprocessable(report["code"], report["detail"])
    proposals, indexed = report["proposals"], dict(report["indexed"])
    return indexed | {
        "without_coordinates": len(proposals),
        "located": sum(each["accepted"] for each in proposals),
    }


@periodic_task(60.0)
def repeat_library_syncs(catalog: Catalog) -> bool:
    """Queue each job of a library again that has ended `every_hours` ago."""
    with catalog.write() as session:
        ended = select(Job).where(
            Job.kind == JobKind.SYNC_LIBRARY, Job.state.in_((JobState.SUCCEEDED, JobState.FAILED))
        )
        jobs = session.scalars(ended.with_for_update(skip_locked=True))
        scheduled = [job for job in jobs if job.params["every_hours"]]
        for job in scheduled:
            assert job.finished_at is not None
            if job.finished_at + timedelta(hours=job.params["every_hours"]) <= datetime.now(UTC):
                requeue_job_as_new(job, keep_result=True)
    return bool(scheduled)
