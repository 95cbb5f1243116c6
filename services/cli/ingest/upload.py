"""Many photos into a map: uploaded in parallel, then waited for until all are searchable.

A batch into a map, brought in by the server and waited for: an archive that is sent as it is, or
objects of the server's own store.

What an interrupted `placewise index` has done already: `--journal FILE`.
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
    """A photo that the server has taken."""

    file_id: str
    job_id: str | None


class UploadJournal:
    """One line for each photo that was taken, written when the server has said so.

    A photo counts as done if its file has the size and the time of last change that it had then,
    and the same is said of it. A last line that a kill has cut off is passed over. It belongs to
    one server and one map: InvalidRequest (`bad_journal`) for another one's, or what is no journal.
    """

    def __init__(self, path: Path, url: str, map_name: str | None) -> None:
        self._path = path
        self._done: dict[str, dict[str, Any]] = {}
        about = {"placewise_journal": JOURNAL_FORMAT, "server": url, "map": map_name}
        try:
            text = path.read_text() if path.exists() else ""
            self._read(text, about)
            self._file = path.open("a")
            if not text:
                self._write(about)
            elif not text.endswith("\n"):
                self._file.write("\n")  # after a line that was cut off
        except (OSError, UnicodeDecodeError) as error:
            raise Misconfigured(
                "out_unwritable", f"The journal {printable_path(path)} can't be used: {error}."
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
        """What the server has answered, if the photo was taken as it is now."""
        line = self._done.get(printable_path(photo.path))
        if line is None or line["state"] != _file_state(photo):
            return None  # a file that is gone says so when it is sent
        return JournalEntry(line["file_id"], line["job_id"])

    def add(self, photo: LocalPhoto, acknowledged: JournalEntry) -> None:
        self._write(
            {
                "path": printable_path(photo.path),
                "state": _file_state(photo),
                "file_id": acknowledged.file_id,
                "job_id": acknowledged.job_id,
            }
        )

    def _write(self, line: dict[str, Any]) -> None:
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()

    def _read(self, text: str, about: dict[str, Any]) -> None:
        lines = []
        for line in text.splitlines():
            try:
                lines.append(json.loads(line))
            except ValueError:
                continue  # cut off by a kill
        if not text:
            return
        if not lines or lines[0] != about:
            raise InvalidRequest(
                "bad_journal",
                f"{printable_path(self._path)} is no journal of this server and map. Name "
                "another file.",
            )
        self._done = {line["path"]: line for line in lines[1:]}


def _file_state(photo: LocalPhoto) -> list[Any]:
    """What makes the photo another one, as JSON."""
    try:
        about = photo.path.stat()
    except OSError:
        return []
    return [about.st_size, about.st_mtime_ns, photo.name, dict(sorted(photo.fields.items()))]


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
        help=f"Fit a vocabulary at the end, from {MIN_PHOTOS_TO_FIT} photos up, if the map "
        "has none "
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
