"""Many photos into a map: uploaded in parallel, then waited for until all are searchable."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.progress import Progress, TaskID

from services.cli.journal import JournalEntry, UploadJournal
from services.cli.output import err_console, printable_path
from services.cli.photo_places import LocalPhoto
from services.cli.vocabulary import fit_and_wait
from shared.client import FINISHED, Client, Json
from shared.errors import Conflict, NotFound, PlacewiseError

MIN_PHOTOS_TO_FIT = 50
UPLOAD_CONCURRENCY = 4
RETRY_PERIOD_SECONDS = (
    60.0  # for which a server that is away is waited for; a busy one as long as it says
)
POLL_SECONDS = 1.0  # a job that begins to wait for a vocabulary is not seen by a longer poll

FitOption = Annotated[
    bool,
    typer.Option(
        "--fit/--no-fit",
        help=f"Fit a vocabulary at the end, from {MIN_PHOTOS_TO_FIT} photos up, if the map has none "
        "of its own.",
    ),
]
UpdateOption = Annotated[
    bool,
    typer.Option(
        "--update", help="Change what is said otherwise now of photos that are there already."
    ),
]
PendingJobs = list[tuple[LocalPhoto, str]]
"""Photos with the ids of the jobs that describe them."""


def upload_photos(
    client: Client,
    photos: list[LocalPhoto],
    fit: bool,
    progress: Progress,
    *,
    update: bool = False,
    journal: UploadJournal | None = None,
) -> Json:
    """Upload, describe, and fit a vocabulary where the map needs one. Running it again uploads
    the same bytes again and describes nothing twice; what the journal has is not even sent. With
    `update`, what is now said otherwise of a photo that is there already is changed, else such a
    photo is refused.

    Returns counts (`photos`, `uploaded`, `already_there`, `searchable` in the whole map), what is
    `refused` and `failed` with the reasons, and the map's `vocabulary`.
    """
    client.stats()  # a wrong address, key or map is said once and now, not after each photo
    counts: Counter[str] = Counter()
    refused: list[Json] = []
    failed: list[Json] = []
    pending: PendingJobs = []
    uploading = progress.add_task("uploading", total=len(photos))

    def show_wait(error: PlacewiseError, seconds: float) -> None:
        progress.update(uploading, description=f"uploading (waits {seconds:.0f} s: {error.code})")
        if error.code not in waited_for:
            waited_for.add(error.code)
            err_console.print(f"Waiting, then going on: {escape(error.detail)}", soft_wrap=True)

    waited_for: set[str] = set()
    patient = client.patient(RETRY_PERIOD_SECONDS, show_wait)
    left = photos
    if journal is not None:
        left, taken = _split_by_journal(photos, journal)
        pending += taken
        counts["already_there"] += len(photos) - len(left)
        progress.update(uploading, completed=len(photos) - len(left))
    for photo, outcome in _upload_concurrently(patient, left, update):
        progress.update(uploading, advance=1, description="uploading")
        if isinstance(outcome, PlacewiseError):
            refused.append(_photo_failure(photo, outcome.detail))
            continue
        counts["already_there" if outcome["already_there"] else "uploaded"] += 1
        if journal is not None:
            journal.add(photo, JournalEntry(outcome["file_id"], outcome["job_id"]))
        if outcome["status"] not in FINISHED:
            pending.append((photo, outcome["job_id"]))
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
        "searchable": stats["searchable_images"],
        "refused": refused,
        "failed": failed,
        "vocabulary": stats["vocabulary"],
        "fitted": vocabulary,
    }


def _split_by_journal(
    photos: list[LocalPhoto], journal: UploadJournal
) -> tuple[list[LocalPhoto], PendingJobs]:
    """The photos that the journal does not have, and the jobs of those that it has."""
    left: list[LocalPhoto] = []
    taken: PendingJobs = []
    for photo in photos:
        done = journal.done(photo)
        if done is None:
            left.append(photo)
        elif done.job_id is not None:
            taken.append((photo, done.job_id))
    return left, taken


def fit_vocabulary_if_needed(
    client: Client, stats: Json, progress: Progress
) -> tuple[Json, Json | None]:
    """Fit a vocabulary where the map has none of its own and photos enough; the map's figures after
    that, and the vocabulary if one was fitted."""
    if stats["vocabulary"] not in ("foreign", None) or stats["total_images"] < MIN_PHOTOS_TO_FIT:
        return stats, None
    vocabulary = fit_and_wait(client, {}, progress)
    return client.stats(), vocabulary


def _upload_concurrently(
    client: Client, photos: list[LocalPhoto], update: bool
) -> Iterator[tuple[LocalPhoto, Json | PlacewiseError]]:
    def upload(photo: LocalPhoto) -> Json | PlacewiseError:
        fields: dict[str, Any] = dict(photo.fields)

        def send() -> Json:
            return client.upload(photo.path, filename=photo.name, **fields)

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
    """The upload form's text fields as a PATCH takes them."""
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
    """Wait for the jobs; returns those that wait for a vocabulary and can't end before it."""
    waiting: PendingJobs = []
    for photo, job_id in pending:
        wait_seconds = 0.0
        while True:
            try:
                job = client.job(job_id, wait_seconds)
            except NotFound:  # a journal's photo, deleted since: that was meant
                progress.advance(bar)
                break
            wait_seconds = POLL_SECONDS
            if job["state"] in FINISHED:
                progress.advance(bar)
                if job["state"] != "succeeded":
                    error: Json = job["error"] or {}
                    failed.append(_photo_failure(photo, str(error.get("detail", job["state"]))))
                break
            if job["waiting_for"]:
                waiting.append((photo, job_id))
                break
    return waiting


def _photo_failure(photo: LocalPhoto, reason: str) -> Json:
    named = {"filename": photo.name} if photo.name else {}
    return {"path": printable_path(photo.path), **named, "reason": reason}
