"""Bulk uploads of local photos: in parallel, with a vocabulary fit if the map needs one."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Annotated, Any

import typer
from rich.progress import Progress, TaskID

from placewise.answers import FINISHED, Job, Stats, Uploaded
from placewise.client import Client
from services.cli.descriptors.vocabulary import fit_and_wait
from services.cli.ingest.geotags import LocalPhoto
from services.cli.ingest.upload_journal import JournalEntry, UploadJournal
from services.cli.output import Json, print_note, printable_path
from shared.errors import Conflict, NotFound, PlacewiseError
from shared.extractor_config.configs import MIN_PHOTOS_TO_FIT

UPLOAD_CONCURRENCY = 4
# How long calls are retried while the server is unavailable. A busy server (429) is retried for as
# long as its Retry-After says.
RETRY_PERIOD_SECONDS = 60.0
POLL_SECONDS = 1.0  # short: a long poll does not return when a job starts to wait for a vocabulary

FitOption = Annotated[
    bool,
    typer.Option(
        "--fit/--no-fit",
        help="Fit a vocabulary afterwards if the map has none of its own and at least "
        f"{MIN_PHOTOS_TO_FIT} photos.",
    ),
]
UpdateOption = Annotated[
    bool,
    typer.Option("--update", help="Update the metadata of photos that are already stored."),
]
PendingJobs = list[tuple[LocalPhoto, str]]
"""Photos with the IDs of the jobs that describe them."""


def upload_photos(
    client: Client,
    photos: list[LocalPhoto],
    fit: bool,
    progress: Progress,
    *,
    update: bool = False,
    journal: UploadJournal | None = None,
) -> Json:
    """Upload photos, wait until they are described, and fit a vocabulary if the map needs one.

    The operation is idempotent: a photo that is already stored is not described again.

    With `update`, the metadata of stored photos that differ is changed; otherwise such photos are
    refused. Uploads that the journal records are skipped, and new ones are recorded.

    Returns:
        Counts (`photos`, `uploaded`, `already_there`, and `searchable` in the whole map), the
        `refused` and `failed` photos with reasons, the kind of the map's `vocabulary`, and the
        vocabulary that was `fitted`, if any.
    """
    client.stats()  # fails early, and once, for a wrong URL, key or map
    counts: Counter[str] = Counter()
    refused: list[Json] = []
    failed: list[Json] = []
    pending: PendingJobs = []
    uploading = progress.add_task("uploading", total=len(photos))

    def show_wait(error: PlacewiseError, seconds: float) -> None:
        progress.update(
            uploading, description=f"uploading (retry in {seconds:.0f} s: {error.code})"
        )
        if error.code not in reported_codes:
            reported_codes.add(error.code)
            print_note(f"Retrying: {error.detail}")

    reported_codes: set[str] = set()
    retrying_client = client.with_patience(RETRY_PERIOD_SECONDS, show_wait)
    remaining = photos
    if journal is not None:
        remaining, recorded_jobs = _split_by_journal(photos, journal)
        pending += recorded_jobs
        counts["already_there"] += len(photos) - len(remaining)
        progress.update(uploading, completed=len(photos) - len(remaining))
    for photo, outcome in _upload_concurrently(retrying_client, remaining, update):
        progress.update(uploading, advance=1, description="uploading")
        if isinstance(outcome, PlacewiseError):
            refused.append(_photo_failure(photo, outcome.detail))
            continue
        counts["already_there" if outcome.already_there else "uploaded"] += 1
        job_id = None if outcome.job_id is None else str(outcome.job_id)
        if journal is not None:
            journal.add(photo, JournalEntry(str(outcome.file_id), job_id))
        if job_id is not None and outcome.status not in FINISHED:
            pending.append((photo, job_id))
    describing = progress.add_task("describing", total=len(pending))
    pending = _wait_for_jobs(client, pending, failed, progress, describing)

    stats, vocabulary = client.stats(), None
    if fit:
        stats, vocabulary = fit_vocabulary_if_needed(client, stats, progress)
    _wait_for_jobs(client, pending, failed, progress, describing)
    return {
        "photos": len(photos),
        "uploaded": counts["uploaded"],
        "already_there": counts["already_there"],
        "searchable": stats.searchable_images,
        "refused": refused,
        "failed": failed,
        "vocabulary": stats.vocabulary,
        "fitted": vocabulary,
    }


def _split_by_journal(
    photos: list[LocalPhoto], journal: UploadJournal
) -> tuple[list[LocalPhoto], PendingJobs]:
    """The photos that the journal does not contain, and the jobs of those that it contains."""
    remaining: list[LocalPhoto] = []
    recorded_jobs: PendingJobs = []
    for photo in photos:
        done = journal.done(photo)
        if done is None:
            remaining.append(photo)
        elif done.job_id is not None:
            recorded_jobs.append((photo, done.job_id))
    return remaining, recorded_jobs


def fit_vocabulary_if_needed(
    client: Client, stats: Stats, progress: Progress
) -> tuple[Stats, Job | None]:
    """Fit a vocabulary if the map has none of its own and enough photos.

    Returns:
        The map's statistics afterwards, and the job of the fit or None.
    """
    if stats.vocabulary in ("own", "none") or stats.total_images < MIN_PHOTOS_TO_FIT:
        return stats, None
    vocabulary = fit_and_wait(client, {}, progress)
    return client.stats(), vocabulary


def _upload_concurrently(
    client: Client, photos: list[LocalPhoto], update: bool
) -> Iterator[tuple[LocalPhoto, Uploaded | PlacewiseError]]:
    def upload(photo: LocalPhoto) -> Uploaded | PlacewiseError:
        fields: dict[str, Any] = {"relative_path": photo.relative_path, **photo.fields}
        send = partial(client.upload, photo.path, filename=photo.name, **fields)
        try:
            try:
                return send()
            except Conflict as error:
                if error.code != "photo_differs" or not update:
                    raise
                client.patch_photo(error.extra["file_id"], **_patch_fields(photo.fields))
                return send()
        except PlacewiseError as error:
            return error

    with ThreadPoolExecutor(UPLOAD_CONCURRENCY) as pool:
        yield from zip(photos, pool.map(upload, photos), strict=True)


def _patch_fields(fields: dict[str, str]) -> Json:
    """Convert the text fields of an upload form to the JSON fields of a PATCH."""
    typed: Json = dict(fields)
    for name in ("latitude", "longitude", "heading"):
        if name in typed:
            typed[name] = float(typed[name])
    if "tags" in typed:
        typed["tags"] = typed["tags"].split(",")
    if "metadata" in typed:
        typed["metadata"] = json.loads(typed["metadata"])
    return typed


def _wait_for_jobs(
    client: Client, pending: PendingJobs, failed: list[Json], progress: Progress, bar: TaskID
) -> PendingJobs:
    """Wait until jobs end; returns those that can't end before the map has a vocabulary."""
    waiting: PendingJobs = []
    for photo, job_id in pending:
        try:
            job = client.job(job_id)  # at once: thousands of jobs may wait for a vocabulary
            while not job.finished and not job.waiting_for:
                job = client.job(job_id, POLL_SECONDS)
        except NotFound:  # recorded in the journal and deleted since
            progress.advance(bar)
            continue
        if not job.finished:
            waiting.append((photo, job_id))
            continue
        progress.advance(bar)
        if job.state != "succeeded":
            failed.append(_photo_failure(photo, job.failure))
    return waiting


def _photo_failure(photo: LocalPhoto, reason: str) -> Json:
    filename = {"filename": photo.name} if photo.name else {}
    return {"path": printable_path(photo.path), **filename, "reason": reason}
