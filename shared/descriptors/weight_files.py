"""Weight files: resumable verified downloads, the Hugging Face cache, safe loading of tensors.

Downloads are kept beside the target as `NAME.part`, with the server's ETag in `NAME.part.etag`. The
next attempt, of this process or of another one, requests the rest, and starts over if the file has
changed on the server (RFC 9110, 13.1.5 and 14). Only a file with the expected hash is accepted.

Files of the Hugging Face hub are downloaded into the hub's own cache as a blob named by the hash
that the hub declares; huggingface_hub finds it there and links it into the snapshot.
huggingface_hub's own download starts over in each process and compares sizes only.

Tensors are loaded without running code and without allocating more than the file's size.
"""

from __future__ import annotations

import hashlib
import pickle
import re
import time
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import torch
from filelock import FileLock
from safetensors import SafetensorError, safe_open

from shared.errors import Misconfigured

TIMEOUT_SECONDS = 30.0  # maximum time without a byte
MAX_DOWNLOAD_ATTEMPTS = 5  # in a row without progress
RETRY_PAUSE_SECONDS = 1.0  # after the first failure; doubled after each further one
PARTIAL_CONTENT, RANGE_NOT_SATISFIABLE = 206, 416

OnProgress = Callable[[int, int | None], object]
"""Called with the bytes received and the total, which is None if the server does not declare it."""


def ignore_progress(_done: int, _total: int | None) -> None:
    """An `OnProgress` that does nothing."""


def download_file(
    url: str,
    target: Path,
    *,
    sha256: str | None = None,
    headers: dict[str, str] | None = None,
    on_progress: OnProgress = ignore_progress,
) -> None:
    """Download a file, resuming an earlier attempt.

    Args:
        target: Path of the downloaded file; its folder is created if necessary.
        sha256: The expected hexadecimal hash, or a prefix of it.
        headers: HTTP headers of the requests.

    Raises:
        Misconfigured: `download_corrupt` if the hash differs; the file is deleted.
        httpx2.HTTPError: The network or the server failed; the part received so far is kept for
            the next call.
        OSError: The file can't be written.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    part = _sibling_path(target, ".part")
    with (
        FileLock(_sibling_path(target, ".part.lock")),
        httpx2.Client(follow_redirects=True, timeout=TIMEOUT_SECONDS, headers=headers) as client,
    ):
        if target.exists():  # another process has downloaded it
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


def _resume_download(client: httpx2.Client, url: str, part: Path, on_progress: OnProgress) -> None:
    """Append one response to `part`, from its end on; raise if it is incomplete."""
    etag = _sibling_path(part, ".etag")
    begun = _size(part) if etag.exists() else 0
    request_headers = {"Accept-Encoding": "identity"}
    if begun:
        request_headers |= {"Range": f"bytes={begun}-", "If-Range": etag.read_text()}
    with client.stream("GET", url, headers=request_headers) as answer:
        if answer.status_code == RANGE_NOT_SATISFIABLE and begun:
            if answer.headers.get("Content-Range") == f"bytes */{begun}":
                return  # complete; the process that downloaded it ended before the rename
            part.unlink()
            etag.unlink()
            raise httpx2.RemoteProtocolError(f"{url} has no bytes from {begun} on")
        answer.raise_for_status()
        resumed = answer.status_code == PARTIAL_CONTENT and begun > 0
        if resumed and not answer.headers.get("Content-Range", "").startswith(f"bytes {begun}-"):
            raise httpx2.RemoteProtocolError(f"{url} returned another range than requested")
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
    """Store a strong ETag; a weak one does not guarantee identical bytes."""
    if etag is None or etag.startswith("W/"):
        path.unlink(missing_ok=True)
    else:
        path.write_text(etag)


def _is_transient(error: httpx2.HTTPError) -> bool:
    """Whether a retry may succeed."""
    if isinstance(error, httpx2.HTTPStatusError):
        return error.response.status_code >= 500 or error.response.status_code == 429
    return not isinstance(error, httpx2.UnsupportedProtocol)


def _check_hash(url: str, part: Path, sha256: str | None) -> None:
    if sha256 is None:
        return
    with part.open("rb") as file:
        actual = hashlib.file_digest(file, "sha256").hexdigest()
    if actual.startswith(sha256.lower()):
        return
    part.unlink()
    _sibling_path(part, ".etag").unlink(missing_ok=True)
    raise Misconfigured(
        "download_corrupt",
        f"{url} is not the expected file: its sha256 is {actual[:16]}..., expected "
        f"{sha256[:16]}.... The download was deleted. Try again; if the error persists, a proxy "
        "changes files in transit, or the file was replaced: copy it from another machine.",
    )


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _sibling_path(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


def download_hub_file(repository: str, filename: str, on_progress: OnProgress) -> Path:
    """Download the newest version of a file of the hub and return its path in the cache.

    HF_ENDPOINT, HF_TOKEN and HF_HOME are honoured.

    Raises:
        Misconfigured: `download_corrupt` if the hash differs.
        OSError, RuntimeError, httpx2.HTTPError: The file can't be downloaded.
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
    # Small files have a git hash, which is not the sha256 of their content.
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
"""Raised by `load_tensors` and safetensors for damaged files and files of other kinds."""

ZIP = b"PK\x03\x04"  # magic bytes of files of PyTorch 1.6 or newer


def load_tensors(path: Path) -> Any:
    """Load a file of `torch.save`: tensors and plain values, on the CPU.

    Tensors are mapped from the file; copy those that must outlive a change of the file. No code is
    executed. Before an archive's entries are read, their declared sizes are compared with the
    file's: PyTorch does not compress entries, so together they are never larger.

    Raises:
        One of TENSOR_READ_ERRORS.
    """
    with path.open("rb") as file:
        is_archive = file.read(len(ZIP)) == ZIP
    if is_archive:
        _check_entries(path)
    # Files of older releases are not archives: uncompressed, and they can't be mapped.
    return torch.load(path, map_location="cpu", weights_only=True, mmap=is_archive)


def is_safetensors(path: Path) -> bool:
    """Whether a file has the format by its content: blobs in the hub's cache have no suffix."""
    with path.open("rb") as file:
        return file.read(9)[8:] == b"{"


Shape = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class TensorFile:
    """The tensors of a file by name; each is read on demand."""

    path: Path
    shapes: dict[str, Shape]
    read: Callable[[str], torch.Tensor]
    """Returns the tensor of a name, on the CPU, with its stored dtype."""


def open_tensor_file(path: Path) -> TensorFile:
    """Open a `.safetensors` or PyTorch file; only its index is read, and no code is executed.

    Raises:
        One of TENSOR_READ_ERRORS, also for a file without tensors.
    """
    if is_safetensors(path):
        stored: Any = safe_open(path, framework="pt", device="cpu")  # untyped methods
        shapes = {name: tuple(stored.get_slice(name).get_shape()) for name in stored.keys()}  # noqa: SIM118
        return TensorFile(path, shapes, stored.get_tensor)
    state = load_tensors(path)
    if not isinstance(state, dict):
        raise ValueError(f"it holds a {type(state).__name__}, not named tensors")
    tensors = {str(n): t for n, t in state.items() if isinstance(t, torch.Tensor)}
    if not tensors:
        raise ValueError(f"it holds no tensors, only {', '.join(map(str, list(state)[:3]))}")
    return TensorFile(path, {n: tuple(t.shape) for n, t in tensors.items()}, tensors.__getitem__)


def shape_differences(
    stored: Mapping[str, Shape], expected: Mapping[str, Shape], *, may_have_more: bool = False
) -> str:
    """Return how stored tensors differ from the expected ones, the first three differences."""
    differences = [
        f"it has no tensor {n} {shape}" for n, shape in expected.items() if n not in stored
    ]
    differences += [
        f"{n} is {stored[n]}, expected {shape}"
        for n, shape in expected.items()
        if stored.get(n, shape) != shape
    ]
    if not may_have_more:
        differences += [f"{n} is not in the network" for n in stored if n not in expected]
    more = f" and {len(differences) - 3} more" if len(differences) > 3 else ""
    return "; ".join(differences[:3]) + more


def check_declared_size(tensors: Iterable[torch.Tensor], path: Path) -> None:
    """Raise ValueError if the tensors' shapes declare more bytes than their file has.

    A few bytes can declare tensors of any shape: repeated views, sparse and empty tensors.
    """
    declared = sum(tensor.numel() * tensor.element_size() for tensor in tensors)
    size = path.stat().st_size
    if declared > size:
        raise ValueError(
            f"its tensors have {declared} bytes by their shapes, and the file has {size}"
        )


def _check_entries(path: Path) -> None:
    """Raise ValueError if the entries of an archive declare more bytes than it has."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, NotImplementedError) as error:
        raise ValueError(f"it is a damaged archive: {error}") from error
    # PyTorch's own reader, which not all releases let tell sizes, may find others in a hostile one.
    reader: Any = torch._C.PyTorchFileReader(str(path))
    read = {name: reader.get_record_header_offset(name) for name in reader.get_all_records()}
    if read != {each.filename.partition("/")[2]: each.header_offset for each in entries}:
        raise ValueError(
            "two readers find other entries in it. Save the file again with torch.save"
        )
    declared, size = sum(each.file_size for each in entries), path.stat().st_size
    if declared > size:
        raise ValueError(
            f"its entries declare {declared} bytes, and the file has {size}: they are compressed "
            "or overlap. torch.save writes neither; save the file again with it"
        )


def first_error_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its class name if it has none."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
