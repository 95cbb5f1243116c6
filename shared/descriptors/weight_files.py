"""Downloading a large file: goes on where it broke off, and keeps only what has the right hash.

What has come lies beside the target as `NAME.part`, with the server's ETag in `NAME.part.etag`:
the next try, of this process or of another one, asks for the rest, and begins anew where the server
says that the file has changed (RFC 9110, 13.1.5 and 14).

Files of the Hugging Face hub, in its own cache: downloads that go on, checked by their hash.

huggingface_hub's own download begins anew in each process and compares sizes only. Here the file is
brought as a blob of the cache, whose name is the hash that the hub promises; huggingface_hub finds
it there and gives it its place in the snapshot.

Files of tensors: read without running their code, or inflating more than they have bytes.
"""

from __future__ import annotations

import hashlib
import pickle
import re
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import httpx2
import torch
from filelock import FileLock
from safetensors import SafetensorError

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


def download_hub_file(repository: str, filename: str, on_progress: OnProgress) -> Path:
    """The file in the cache of this machine, the newest that the hub has.

    Misconfigured (`download_corrupt`) when it has another hash; OSError, RuntimeError or
    httpx2.HTTPError when it can't be had. HF_ENDPOINT, HF_TOKEN and HF_HOME are honoured.
    """
    import huggingface_hub
    from huggingface_hub import constants
    from huggingface_hub.file_download import repo_folder_name
    from huggingface_hub.utils import build_hf_headers  # type: ignore[attr-defined]

    url = huggingface_hub.hf_hub_url(repository, filename)
    metadata = huggingface_hub.get_hf_file_metadata(url)
    if metadata.etag is None:
        raise OSError(f"{url} has no ETag")
    folder = repo_folder_name(repo_id=repository, repo_type="model")
    # Small files have git's hash, which is of more than their content.
    sha256 = metadata.etag if re.fullmatch(r"[0-9a-f]{64}", metadata.etag) else None
    download_file(
        url,
        Path(constants.HF_HUB_CACHE, folder, "blobs", metadata.etag),
        sha256=sha256,
        headers=build_hf_headers(),
        on_progress=on_progress,
    )
    return Path(huggingface_hub.hf_hub_download(repository, filename))


TENSOR_READ_ERRORS = (
    OSError,
    EOFError,
    RuntimeError,
    AssertionError,
    KeyError,
    ValueError,
    TypeError,
    SafetensorError,
    pickle.UnpicklingError,
)
"""What `load_tensors` and safetensors raise for damaged and for other files."""

ZIP = b"PK\x03\x04"  # how a file of PyTorch 1.6 or newer begins


def load_tensors(path: Path) -> Any:
    """What a file of `torch.save` holds: tensors and plain values, on the CPU.

    Tensors are mapped from the file, so copy those that are to outlive a change of it. Nothing is
    executed. Of an archive, no entry is read before the sizes that all of them declare were
    compared with the file's: PyTorch does not compress them, so they are never larger.

    Raises:
        One of UNREADABLE.
    """
    with path.open("rb") as file:
        is_archive = file.read(len(ZIP)) == ZIP
    if is_archive:
        _check_entries(path)
    # Files of older releases hold storages one after the other, uncompressed, and can't be mapped.
    return torch.load(path, map_location="cpu", weights_only=True, mmap=is_archive)


def check_promise(tensors: Iterable[torch.Tensor], path: Path) -> None:
    """ValueError when the tensors have more bytes than their file.

    Tensors of any shape can be made of a few bytes: repeated views, sparse and empty ones.
    """
    promised, size = sum(one.numel() * one.element_size() for one in tensors), path.stat().st_size
    if promised > size:
        raise ValueError(
            f"its tensors have {promised} bytes by their shapes, and the file has {size}"
        )


def _check_entries(path: Path) -> None:
    # PyTorch's own reader: what another one finds in a hostile archive may be other entries.
    archive = torch._C.PyTorchFileReader(str(path))
    declared = sum(archive.get_record_size(name) for name in archive.get_all_records())
    size = path.stat().st_size
    if declared > size:
        raise ValueError(
            f"its entries declare {declared} bytes, and the file has {size}: they are compressed "
            "or overlap. torch.save writes neither; save the file again with it"
        )


def first_error_line(error: BaseException) -> str:
    """What an error says, in one line; its name where it says nothing."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
