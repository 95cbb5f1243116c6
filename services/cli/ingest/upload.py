"""Bulk uploads into a map: parallel uploads of local photos, archives and server-side imports.

Each function waits until the photos are described and fits a vocabulary if the map has none of its
own. `UploadJournal` (`placewise index --journal FILE`) records acknowledged uploads, so that an
interrupted run can be resumed.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Self

import typer
from rich.markup import escape
from rich.progress import Progress, TaskID

from services.cli.descriptors.vocabulary import fit_and_wait
from services.cli.ingest.geotags import LocalPhoto
from services.cli.output import err_console, printable_path
from shared.client import FINISHED, Client, Json
from shared.errors import (
    Conflict,
    InvalidRequest,
    Misconfigured,
    NotFound,
    PlacewiseError,
    Unprocessable,
)
from shared.imaging.file_formats import (
    ACCEPTED_ARCHIVES,
    ARCHIVE_SIGNATURE_BYTES,
    detect_archive_format,
)
from shared.ingest.photo_metadata import KEY_FIELD

JOURNAL_FORMAT = 1


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """A photo whose upload the server has acknowledged."""

    file_id: str
    job_id: str | None


class UploadJournal:
    """A JSONL file with one line per photo, appended when the server acknowledges the upload.

    A photo counts as uploaded while its file's size and modification time and its metadata are
    unchanged. An incomplete last line, left by a killed process, is ignored. A journal belongs to
    one server and one map.

    Raises:
        InvalidRequest: `bad_journal` if the file is not a journal of this server and map.
        Misconfigured: `out_unwritable` if the file can't be read or written.
    """

    def __init__(self, path: Path, url: str, map_name: str | None) -> None:
        self._path = path
        self._done: dict[str, dict[str, Any]] = {}
        header = {"placewise_journal": JOURNAL_FORMAT, "server": url, "map": map_name}
        try:
            text = path.read_text() if path.exists() else ""
            self._read(text, header)
            self._file = path.open("a")
            if not text:
                self._write(header)
            elif not text.endswith("\n"):
                self._file.write("\n")  # ends an incomplete last line
        except (OSError, UnicodeDecodeError) as error:
            raise Misconfigured(
                "out_unwritable", f"Can't use the journal {printable_path(path)}: {error}."
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def done(self, photo: LocalPhoto) -> JournalEntry | None:
        """The recorded upload of the photo, or None if it is new or has changed."""
        line = self._done.get(printable_path(photo.path))
        if line is None or line["state"] != _file_state(photo):
            return None  # a missing file is reported by the upload itself
        return JournalEntry(line["file_id"], line["job_id"])

    def add(self, photo: LocalPhoto, entry: JournalEntry) -> None:
        """Record an acknowledged upload."""
        self._write(
            {
                "path": printable_path(photo.path),
                "state": _file_state(photo),
                "file_id": entry.file_id,
                "job_id": entry.job_id,
            }
        )

    def _write(self, line: dict[str, Any]) -> None:
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()

    def _read(self, text: str, header: dict[str, Any]) -> None:
        lines = []
        for line in text.splitlines():
            try:
                lines.append(json.loads(line))
            except ValueError:
                continue  # incomplete: the process was killed while writing it
        if not text:
            return
        if not lines or lines[0] != header:
            raise InvalidRequest(
                "bad_journal",
                f"{printable_path(self._path)} is not a journal of this server and map. Use "
                "another file.",
            )
        self._done = {line["path"]: line for line in lines[1:]}


def _file_state(photo: LocalPhoto) -> list[Any]:
    """The file attributes and metadata whose change requires a new upload, as JSON."""
    try:
        stat = photo.path.stat()
    except OSError:
        return []
    return [stat.st_size, stat.st_mtime_ns, photo.name, dict(sorted(photo.fields.items()))]


MIN_PHOTOS_TO_FIT = 50
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

    Args:
        client: Client of the map.
        photos: Photos to upload.
        fit: Fit a vocabulary if the map has none of its own and enough photos.
        progress: Shows uploads and jobs.
        update: Change the metadata of stored photos that differ; otherwise such photos are refused.
        journal: Skips the uploads recorded in it and records new ones.

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
            err_console.print(f"Retrying: {escape(error.detail)}", soft_wrap=True)

    reported_codes: set[str] = set()
    retrying_client = client.patient(RETRY_PERIOD_SECONDS, show_wait)
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
    client: Client, stats: Json, progress: Progress
) -> tuple[Json, Json | None]:
    """Fit a vocabulary if the map has none of its own and enough photos.

    Args:
        client: Client of the map.
        stats: The map's current statistics.
        progress: Shows the job.

    Returns:
        The map's statistics afterwards, and the job of the fit or None.
    """
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
        wait_seconds = 0.0
        while True:
            try:
                job = client.job(job_id, wait_seconds)
            except NotFound:  # recorded in the journal and deleted since
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
    filename = {"filename": photo.name} if photo.name else {}
    return {"path": printable_path(photo.path), **filename, "reason": reason}


BLOCKED_POLL_SECONDS = 2.0


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
    failed_items = list(client.batch_items(started["job_id"], "failed", "cancelled"))
    counts: Json = job["result"] or {}
    already_stored = counts.get("already_there", 0)
    return {
        "photos": job["progress"]["total"],
        "uploaded": job["progress"]["total"]
        - already_stored
        - sum(not item["file_id"] for item in failed_items),
        "already_there": already_stored,
        "searchable": client.stats()["searchable_images"],
        "refused": [_item_failure(item) for item in failed_items if not item["file_id"]],
        "failed": [_item_failure(item) for item in failed_items if item["file_id"]],
        "vocabulary": stats["vocabulary"],
        "fitted": fitted,
        "ignored": counts.get("ignored", 0),
    }


def _wait_until_finished(client: Client, job_id: str, progress: Progress, bar: TaskID) -> Json:
    """Poll a job until it ends or waits for a vocabulary."""
    wait_seconds, reported = 0.0, False
    while True:
        job = client.job(job_id, wait_seconds)
        wait_seconds = POLL_SECONDS
        counts: Json = job["progress"]
        progress.update(
            bar, completed=counts["done"] + counts["failed"], total=counts["total"] or None
        )
        if job["state"] in FINISHED or job["waiting_for"] == "vocabulary":
            return job
        if job["waiting_for"]:
            if not reported:
                reason = job["waiting_for"].replace("_", " ")
                err_console.print(
                    f"The batch is waiting for {reason} on the server; it continues automatically."
                )
            reported = True
            # Long polls return at once for a job that waits for something.
            time.sleep(BLOCKED_POLL_SECONDS)


def _item_failure(item: Json) -> Json:
    error: Json = item["error"] or {}
    return {"path": item["name"], "reason": str(error.get("detail", item["state"]))}
