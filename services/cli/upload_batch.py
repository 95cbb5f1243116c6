"""A batch into a map, brought in by the server and waited for: an archive that is sent as it is, or
objects of the server's own store."""

from __future__ import annotations

import json
import time
from pathlib import Path

from rich.progress import Progress, TaskID

from services.cli.output import err_console
from services.cli.upload_many import POLL_SECONDS, fit_vocabulary_if_needed
from shared.archive_formats import ACCEPTED_ARCHIVES, ARCHIVE_SIGNATURE_BYTES, detect_archive_format
from shared.client import FINISHED, Client, Json
from shared.errors import InvalidRequest, Unprocessable
from shared.intake.manifest import KEY_FIELD

WAITING_LOOK_SECONDS = 2.0


def check_archive(path: Path) -> None:
    """InvalidRequest (`not_an_archive`) for a file that the server would refuse."""
    try:
        with path.open("rb") as file:
            begin = file.read(ARCHIVE_SIGNATURE_BYTES)
    except OSError as error:
        raise InvalidRequest("unreadable_file", f"Can't read {path}: {error.strerror}") from error
    if detect_archive_format(begin) is None:
        raise InvalidRequest(
            "not_an_archive",
            f"{path} is no folder, and by its content not {ACCEPTED_ARCHIVES}.",
        )


def upload_archive(client: Client, archive: Path, fit: bool, progress: Progress) -> Json:
    """Upload, describe, and fit a vocabulary where the map needs one.

    Returns what `upload_photos` does. Raises the reason of a batch that has failed as a whole.
    """
    client.stats()  # a wrong address, key or map is said before gigabytes are sent
    sending = progress.add_task("uploading (bytes)", total=archive.stat().st_size)
    started = client.upload_archive(
        archive, lambda sent_bytes: progress.update(sending, completed=sent_bytes)
    )
    return _wait_and_report(client, started, fit, progress)


def import_prefix(client: Client, prefix: str, fit: bool, progress: Progress) -> Json:
    """As `upload_archive`, with every photo of the server's store below the prefix."""
    return _wait_and_report(client, client.import_prefix(prefix), fit, progress)


def manifest_has_keys(manifest: bytes) -> bool:
    """Does the first line of a JSONL manifest name an object by its key, not a file?"""
    first = next((line for line in manifest.splitlines() if line.strip()), b"")
    try:
        return KEY_FIELD in json.loads(first)
    except (ValueError, TypeError, RecursionError):
        return False  # whoever reads it whole says what is wrong


def import_keys(client: Client, manifest: bytes, fit: bool, progress: Progress) -> Json:
    """As `upload_archive`, with the objects that the lines of the manifest name by `key`."""
    return _wait_and_report(client, client.import_manifest(manifest), fit, progress)


def _wait_and_report(client: Client, started: Json, fit: bool, progress: Progress) -> Json:
    describing = progress.add_task("describing", total=None)
    job = _wait_until_finished(client, started["job_id"], progress, describing)
    stats, fitted = client.stats(), None
    if fit:
        stats, fitted = fit_vocabulary_if_needed(client, stats, progress)
    if job["state"] not in FINISHED and stats["vocabulary"] is not None:
        job = _wait_until_finished(client, started["job_id"], progress, describing)
    if job["state"] in ("failed", "cancelled"):
        error: Json = job["error"] or {}
        raise Unprocessable(
            error.get("code", "job_ended"), error.get("detail", f"The batch was {job['state']}.")
        )
    bad = list(client.batch_items(started["job_id"], "failed", "cancelled"))
    counts: Json = job["result"] or {}
    there = counts.get("already_there", 0)
    return {
        "photos": job["progress"]["total"],
        "uploaded": job["progress"]["total"] - there - sum(not item["file_id"] for item in bad),
        "already_there": there,
        "searchable": client.stats()["searchable_images"],
        "refused": [_item_failure(item) for item in bad if not item["file_id"]],
        "failed": [_item_failure(item) for item in bad if item["file_id"]],
        "vocabulary": stats["vocabulary"],
        "fitted": fitted,
        "ignored": counts.get("ignored", 0),
    }


def _wait_until_finished(client: Client, job_id: str, progress: Progress, bar: TaskID) -> Json:
    """The job once it has ended, or waits for a vocabulary."""
    wait_seconds, told = 0.0, False
    while True:
        job = client.job(job_id, wait_seconds)
        wait_seconds = POLL_SECONDS
        done: Json = job["progress"]
        progress.update(bar, completed=done["done"] + done["failed"], total=done["total"] or None)
        if job["state"] in FINISHED or job["waiting_for"] == "vocabulary":
            return job
        if job["waiting_for"]:
            if not told:
                what = job["waiting_for"].replace("_", " ")
                err_console.print(
                    f"The batch waits for {what} on the server, and goes on by itself."
                )
            told = True
            time.sleep(WAITING_LOOK_SECONDS)  # a server answers at once for a job that waits


def _item_failure(item: Json) -> Json:
    error: Json = item["error"] or {}
    return {"path": item["name"], "reason": str(error.get("detail", item["state"]))}
