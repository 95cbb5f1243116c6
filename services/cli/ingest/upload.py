"""Bulk uploads: local photos one by one, or batches of objects that the server has.

Batches are bucket prefixes and lists of object keys. Both ways wait until the photos are described,
and for the vocabulary fit that the server starts if the map has enough photos.
"""

from __future__ import annotations

import contextlib
import functools
import json
import time
from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Annotated, Any
from uuid import UUID

import typer
from rich.progress import Progress, TaskID

from placewise.answers import FINISHED, BatchItem, BatchStarted, Job, Uploaded
from placewise.client import Client
from placewise.protocol import printable_name
from services.cli.client import wait_for_job
from services.cli.ingest.geotags import LocalPhoto
from services.cli.output import Json, print_note, utf8_path
from shared.errors import Conflict, NotFound, PlacewiseError, Unavailable, Unprocessable
from shared.ingest.photo_metadata import KEY_FIELD

UPLOAD_CONCURRENCY = 4
UPLOADS_AHEAD = 2 * UPLOAD_CONCURRENCY  # so that one slow upload does not stop the others
# How long calls are retried while the server is unavailable. A busy server (429) is retried for as
# long as its Retry-After says.
RETRY_PERIOD_SECONDS = 60.0
POLL_SECONDS = 1.0  # short: a long poll does not return when a job starts to wait for a vocabulary

# For the steward to start a fit that is due: it waits until no photo arrives for some seconds.
FIT_START_SECONDS = 60.0

NoFitOption = Annotated[
    bool,
    typer.Option(
        "--no-fit",
        help="Switch automatic vocabulary fits off for this map; `placewise maps update NAME "
        "--auto-fit` switches them on again.",
    ),
]
UpdateOption = Annotated[
    bool,
    typer.Option("--update", help="Update the metadata of photos that are already stored."),
]
PendingJobs = list[tuple[LocalPhoto, UUID | str]]
"""Photos with the IDs of the jobs that describe them."""


def upload_photos(
    client: Client,
    photos: list[LocalPhoto],
    progress: Progress,
    *,
    update: bool = False,
) -> Json:
    """Upload photos, and wait until they are described and an automatic vocabulary fit has ended.

    The operation is idempotent: a photo that is already stored is not described again.

    With `update`, the metadata of stored photos that differ is changed; otherwise such photos are
    refused.

    Returns:
        Counts (`photos`, `uploaded`, `already_there`, `updated`, and `searchable` in the whole
        map), the `refused` and `failed` photos with reasons, the kind of the map's `vocabulary`,
        and the job of the vocabulary that was `fitted`, if any.

    Raises:
        Unavailable: The server was not reached, or had no space, for RETRY_PERIOD_SECONDS.
    """
    client.stats()  # fails early, and once, for a wrong URL, key or map
    counts: Counter[str] = Counter()
    refused: list[Json] = []
    failed: list[Json] = []
    pending: PendingJobs = []
    uploading = progress.add_task("uploading", total=len(photos))

    def note_retry(error: PlacewiseError, _seconds: float) -> None:
        if error.code not in reported_codes:
            reported_codes.add(error.code)
            print_note(f"Retrying: {error.detail}")

    reported_codes: set[str] = set()
    client = client.with_patience(RETRY_PERIOD_SECONDS, note_retry)
    for photo, outcome in _upload_concurrently(client, photos, update):
        progress.advance(uploading)
        if isinstance(outcome, PlacewiseError):
            refused.append(_photo_failure(photo, outcome.detail))
            continue
        counts["already_there" if outcome.already_there else "uploaded"] += 1
        counts["updated"] += bool(outcome.updated)
        if outcome.job_id is not None and outcome.status not in FINISHED:
            pending.append((photo, outcome.job_id))
    describing = progress.add_task("describing", total=len(pending))
    _wait_for_jobs(client, pending, failed, progress, describing)
    fit = wait_for_automatic_fit(client, progress)
    stats = client.stats()
    return {
        "photos": len(photos),
        "uploaded": counts["uploaded"],
        "already_there": counts["already_there"],
        "updated": counts["updated"],
        "searchable": stats.searchable_images,
        "refused": refused,
        "failed": failed,
        "vocabulary": stats.vocabulary,
        "fitted": fit,
    }


def wait_for_automatic_fit(client: Client, progress: Progress) -> Job | None:
    """Wait for the vocabulary fits that run, or are due and that the server is about to start.

    Returns:
        The last one as it ended, also if it failed; None if no fit is due.
    """
    deadline = time.monotonic() + FIT_START_SECONDS
    was_due = False
    while True:
        stats = client.stats()
        job = next(client.jobs(kind="fit", state=["queued", "running"]), None)
        if job is not None:
            break
        if stats.next_fit_photos is None or stats.total_images < stats.next_fit_photos:
            if not was_due:
                return None
            job = next(client.jobs(kind="fit"))  # it started and ended between two polls
            break
        was_due = True
        if time.monotonic() > deadline:
            print_note("The map is improved later: other photos are still being added to it.")
            return None
        time.sleep(POLL_SECONDS)
    try:
        ended = wait_for_job(client, job, progress, job.label.lower())
    except Unprocessable as error:
        print_note(
            f"The photos are stored, but no vocabulary was fitted: {error.detail} "
            "Try it again with `placewise vocabulary fit`."
        )
        return client.job(job)
    return wait_for_automatic_fit(client, progress) or ended  # it may have begun before the photos


def _upload_concurrently(
    client: Client, photos: list[LocalPhoto], update: bool
) -> Iterator[tuple[LocalPhoto, Uploaded | PlacewiseError]]:
    def upload(photo: LocalPhoto) -> Uploaded | PlacewiseError:
        fields: dict[str, Any] = {"relative_path": photo.relative_path, **photo.fields}
        name = photo.name or printable_name(photo.path)
        try:
            send = partial(client.upload, photo.content(), filename=name, **fields)
        except PlacewiseError as error:
            return error
        try:
            try:
                return send()
            except Conflict as error:
                if error.code != "photo_differs" or not update:
                    raise
                client.patch_photo(error.extra["file_id"], **_patch_fields(photo.fields))
                return send()
        except Unavailable:  # of the server, for all photos
            raise
        except PlacewiseError as error:
            return error

    started: deque[tuple[LocalPhoto, Future[Uploaded | PlacewiseError]]] = deque()
    with ThreadPoolExecutor(UPLOAD_CONCURRENCY) as pool:
        for photo in photos:  # only a few ahead, which an interrupt waits for
            started.append((photo, pool.submit(upload, photo)))
            if len(started) == UPLOADS_AHEAD:
                first, future = started.popleft()
                yield first, future.result()
        for each, future in started:
            yield each, future.result()


def _patch_fields(fields: dict[str, str]) -> Json:
    """Convert the text fields of an upload form to the JSON fields of a PATCH."""
    typed: Json = dict(fields)
    if "tags" in typed:
        typed["tags"] = typed["tags"].split(",")
    if "metadata" in typed:
        typed["metadata"] = json.loads(typed["metadata"])
    return typed


def _wait_for_jobs(
    client: Client, pending: PendingJobs, failed: list[Json], progress: Progress, bar: TaskID
) -> None:
    """Wait until jobs end, and note those that fail."""
    for photo, job_id in pending:
        with contextlib.suppress(NotFound):  # the photo was deleted meanwhile
            job = wait_until_described(client, job_id)
            if job.state != "succeeded":
                failed.append(_photo_failure(photo, job.failure))
        progress.advance(bar)


def wait_until_described(client: Client, job_id: str | UUID) -> Job:
    """Wait until the photo's job ends; return it."""
    job = client.job(job_id, POLL_SECONDS)
    while not job.finished:
        if job.error is not None:  # it is retried until an operator has removed the cause
            _note_once(f"The photos wait: {job.error['code']}: {job.failure}")
        job = client.job(job_id, POLL_SECONDS)
    return job


@functools.cache
def _note_once(message: str) -> None:
    print_note(message)


def _photo_failure(photo: LocalPhoto, reason: str) -> Json:
    filename = {"filename": photo.name} if photo.name else {}
    return {"path": utf8_path(photo.path), **filename, "reason": reason}


def manifest_has_keys(manifest: bytes) -> bool:
    """Whether the first line of a JSONL manifest refers to an object key instead of a file."""
    first = next((line for line in manifest.splitlines() if line.strip()), b"")
    try:
        return KEY_FIELD in json.loads(first)
    except (ValueError, TypeError, RecursionError):
        return False  # the parser of the whole manifest reports the error


def wait_for_batch(client: Client, started: BatchStarted, progress: Progress) -> Json:
    """Wait for a batch as `upload_photos` does for its photos.

    Returns:
        The same report as `upload_photos`, with `ignored`: the number of objects that are none.

    Raises:
        Unprocessable: The batch as a whole failed or was cancelled.
    """
    describing = progress.add_task("describing", total=None)
    job = _wait_until_finished(client, started, progress, describing)
    fit = wait_for_automatic_fit(client, progress)
    stats = client.stats()
    job.raise_for_failure()
    failed_items = list(client.batch_items(started, "failed", "cancelled"))
    refused = [_item_failure(item) for item in failed_items if not item.file_id]
    counts = job.result or {}
    already_stored = counts.get("already_there", 0)
    return {
        "photos": job.progress.total,
        "uploaded": job.progress.total - already_stored - len(refused),
        "already_there": already_stored,
        "searchable": stats.searchable_images,
        "refused": refused,
        "failed": [_item_failure(item) for item in failed_items if item.file_id],
        "vocabulary": stats.vocabulary,
        "fitted": fit,
        "ignored": counts.get("ignored", 0),
    }


def _wait_until_finished(
    client: Client, started: BatchStarted, progress: Progress, bar: TaskID
) -> Job:
    """Wait until a batch ends."""
    for job in client.watch(started, poll_seconds=POLL_SECONDS):
        counts = job.progress
        progress.update(bar, completed=counts.done + counts.failed, total=counts.total or None)
        if job.waiting_for:
            reason = job.waiting_for.replace("_", " ")
            _note_once(f"The batch waits for {reason} on the server; it continues automatically.")
    return job


def _item_failure(item: BatchItem) -> Json:
    return {"path": item.name, "reason": str((item.error or {}).get("detail", item.state))}
