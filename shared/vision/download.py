"""Downloading a large file: goes on where it broke off, and keeps only what has the right hash.

What has come lies beside the target as `NAME.part`, with the server's ETag in `NAME.part.etag`:
the next try, of this process or of another one, asks for the rest, and begins anew where the server
says that the file has changed (RFC 9110, 13.1.5 and 14).
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from pathlib import Path

import httpx2
from filelock import FileLock

from shared.errors import Misconfigured

TIMEOUT_SECONDS = 30.0  # without a byte
MAX_DOWNLOAD_ATTEMPTS = 5  # in a row that brought nothing
RETRY_PAUSE_SECONDS = 1.0  # after the first; twice as long after each further one
PARTIAL_CONTENT, RANGE_NOT_SATISFIABLE = 206, 416

OnProgress = Callable[[int, int | None], object]
"""Called with the bytes that are here, and with all there will be if the server says that."""


def download_file(
    url: str,
    target: Path,
    *,
    sha256: str | None = None,
    headers: dict[str, str] | None = None,
    on_progress: OnProgress = lambda _done, _total: None,
) -> None:
    """Bring the file at `url` to `target`, whose folder is made if need be.

    `sha256` is the hexadecimal hash that it must have, or the beginning of it. Raises Misconfigured
    (`download_corrupt`) for another one, and nothing of it is kept; httpx2.HTTPError when the
    network or the server fails: what has come is kept for the next call; OSError.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    part = _sibling_path(target, ".part")
    with (
        FileLock(_sibling_path(target, ".part.lock")),
        httpx2.Client(follow_redirects=True, timeout=TIMEOUT_SECONDS, headers=headers) as client,
    ):
        if target.exists():  # another process was first
            return
        failures = 0
        while True:
            before = _size(part)
            try:
                _resume_download(client, url, part, on_progress)
                break
            except httpx2.HTTPError as error:
                failures = failures + 1 if _size(part) <= before else 1
                if failures == MAX_DOWNLOAD_ATTEMPTS or not _is_transient(error):
                    raise
                time.sleep(RETRY_PAUSE_SECONDS * 2 ** (failures - 1))
        _check_hash(url, part, sha256)
        part.replace(target)
        _sibling_path(part, ".etag").unlink(missing_ok=True)


def file_sha256(path: Path) -> str:
    """The hexadecimal sha256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _resume_download(client: httpx2.Client, url: str, part: Path, on_progress: OnProgress) -> None:
    """One answer of the server appended to `part`, from where it ends; all of it, or an error."""
    etag = _sibling_path(part, ".etag")
    begun = _size(part) if etag.exists() else 0
    asked = {"Accept-Encoding": "identity"}
    if begun:
        asked |= {"Range": f"bytes={begun}-", "If-Range": etag.read_text()}
    with client.stream("GET", url, headers=asked) as answer:
        if answer.status_code == RANGE_NOT_SATISFIABLE and begun:
            if answer.headers.get("Content-Range") == f"bytes */{begun}":
                return  # it was complete, and its process died before it could say so
            part.unlink()
            etag.unlink()
            raise httpx2.RemoteProtocolError(f"{url} has nothing from byte {begun} on")
        answer.raise_for_status()
        resumed = answer.status_code == PARTIAL_CONTENT and begun > 0
        if resumed and not answer.headers.get("Content-Range", "").startswith(f"bytes {begun}-"):
            raise httpx2.RemoteProtocolError(f"{url} sent another range than was asked for")
        done = begun if resumed else 0
        length = answer.headers.get("Content-Length")
        total = done + int(length) if length is not None else None
        if not resumed:
            _store_etag(etag, answer.headers.get("ETag"))
        with part.open("ab" if resumed else "wb") as file:
            on_progress(done, total)
            for block in answer.iter_raw():
                file.write(block)
                done += len(block)
                on_progress(done, total)
        if total is not None and done != total:
            raise httpx2.RemoteProtocolError(f"{url} ended after {done} of {total} bytes")


def _store_etag(path: Path, etag: str | None) -> None:
    """Only a strong ETag says that two answers are of the same bytes."""
    if etag is None or etag.startswith("W/"):
        path.unlink(missing_ok=True)
    else:
        path.write_text(etag)


def _is_transient(error: httpx2.HTTPError) -> bool:
    """Whether the same call may work a moment later."""
    if isinstance(error, httpx2.HTTPStatusError):
        return error.response.status_code >= 500 or error.response.status_code == 429
    return not isinstance(error, httpx2.UnsupportedProtocol)


def _check_hash(url: str, part: Path, sha256: str | None) -> None:
    if sha256 is None:
        return
    found = file_sha256(part)
    if found.startswith(sha256.lower()):
        return
    part.unlink()
    _sibling_path(part, ".etag").unlink(missing_ok=True)
    raise Misconfigured(
        "download_corrupt",
        f"{url} is not the file that it should be: its sha256 is {found[:16]}..., expected "
        f"{sha256[:16]}.... Nothing of it was kept. Try again; if it stays so, a proxy changes "
        "files on their way, or the file was replaced: bring it from another machine.",
    )


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _sibling_path(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)
