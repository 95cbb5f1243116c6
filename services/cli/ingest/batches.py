"""Batches: archives, bucket prefixes and lists of object keys, which the server ingests itself."""

from __future__ import annotations

import json
from pathlib import Path

from rich.progress import Progress, TaskID

from placewise.answers import BatchItem, BatchStarted, Job
from placewise.client import Client
from services.cli.ingest.upload import POLL_SECONDS, fit_vocabulary_if_needed
from services.cli.output import Json, print_note
from shared.errors import InvalidRequest
from shared.imaging.file_formats import (
    ACCEPTED_ARCHIVES,
    ARCHIVE_SIGNATURE_BYTES,
    detect_archive_format,
)
from shared.ingest.photo_metadata import KEY_FIELD


def check_archive(path: Path) -> None:
    """Check the signature of an archive before it is uploaded.

    Raises:
        InvalidRequest: `not_an_archive`, `unreadable_file`.
    """
    try:
        with path.open("rb") as file:
            signature = file.read(ARCHIVE_SIGNATURE_BYTES)
    except OSError as error:
        raise InvalidRequest("unreadable_file", f"Can't read {path}: {error.strerror}") from error
    if detect_archive_format(signature) is None:
        raise InvalidRequest(
            "not_an_archive",
            f"{path} is neither a folder nor {ACCEPTED_ARCHIVES}.",
        )


def upload_archive(client: Client, archive: Path, fit: bool, progress: Progress) -> Json:
    """Upload an archive as a batch, wait until it ends, and fit a vocabulary if needed.

    Returns:
        The same report as `upload_photos`, with `ignored`: the number of other archive members.

    Raises:
        Unprocessable: The batch as a whole failed or was cancelled.
    """
    client.stats()  # fails before gigabytes are sent if the URL, key or map is wrong
    sending = progress.add_task("uploading (bytes)", total=archive.stat().st_size)
    started = client.upload_archive(
        archive, lambda sent_bytes: progress.update(sending, completed=sent_bytes)
    )
    return _wait_and_report(client, started, fit, progress)


def import_prefix(client: Client, prefix: str, fit: bool, progress: Progress) -> Json:
    """Import every photo of the server's store below a prefix; see `upload_archive`."""
    return _wait_and_report(client, client.import_prefix(prefix), fit, progress)


def manifest_has_keys(manifest: bytes) -> bool:
    """Whether the first line of a JSONL manifest refers to an object key instead of a file."""
    first = next((line for line in manifest.splitlines() if line.strip()), b"")
    try:
        return KEY_FIELD in json.loads(first)
    except (ValueError, TypeError, RecursionError):
        return False  # the parser of the whole manifest reports the error


def import_keys(client: Client, manifest: bytes, fit: bool, progress: Progress) -> Json:
    """Import the objects listed by `key` in a JSONL manifest; see `upload_archive`."""
    return _wait_and_report(client, client.import_manifest(manifest), fit, progress)


def _wait_and_report(client: Client, started: BatchStarted, fit: bool, progress: Progress) -> Json:
    describing = progress.add_task("describing", total=None)
    job = _wait_until_finished(client, started, progress, describing)
    stats, fitted = client.stats(), None
    if fit:
        stats, fitted = fit_vocabulary_if_needed(client, stats, progress)
    if not job.finished and stats.vocabulary is not None:
        job = _wait_until_finished(client, started, progress, describing)
    job.raise_for_failure()
    failed_items = list(client.batch_items(started, "failed", "cancelled"))
    counts = job.result or {}
    already_stored = counts.get("already_there", 0)
    return {
        "photos": job.progress.total,
        "uploaded": job.progress.total
        - already_stored
        - sum(not item.file_id for item in failed_items),
        "already_there": already_stored,
        "searchable": client.stats().searchable_images,
        "refused": [_item_failure(item) for item in failed_items if not item.file_id],
        "failed": [_item_failure(item) for item in failed_items if item.file_id],
        "vocabulary": stats.vocabulary,
        "fitted": fitted,
        "ignored": counts.get("ignored", 0),
    }


def _wait_until_finished(
    client: Client, started: BatchStarted, progress: Progress, bar: TaskID
) -> Job:
    """Wait until a batch ends or waits for a vocabulary."""
    reported = False
    for job in client.watch(started, poll_seconds=POLL_SECONDS):
        counts = job.progress
        progress.update(bar, completed=counts.done + counts.failed, total=counts.total or None)
        if job.waiting_for == "vocabulary":
            break
        if job.waiting_for and not reported:
            reason = job.waiting_for.replace("_", " ")
            print_note(
                f"The batch is waiting for {reason} on the server; it continues automatically."
            )
            reported = True
    return job


def _item_failure(item: BatchItem) -> Json:
    return {"path": item.name, "reason": str((item.error or {}).get("detail", item.state))}
