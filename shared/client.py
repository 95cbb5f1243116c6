"""A client of the HTTP API.

    with Client("http://127.0.0.1:8000") as places:  # beyond loopback: Client(url, key="pw_...")
        uploaded = places.upload(Path("street.jpg"), latitude=45.07, longitude=7.69)
        places.wait_for(uploaded["job_id"])
        answer = places.similar_to_file(Path("where.jpg"), top_k=5)

Answers are the API's JSON. Whatever it refuses is raised as the error that the server raised, with
its status and `code`; a server that can't be reached is Unavailable (`server_unreachable`).

A patient client (`Client(url, patience_seconds=60)`) repeats a call that met a server which is away
or busy. What makes a job or a record is repeated under one Idempotency-Key, so that it is done once
whatever answers were lost.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import io
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self, TypeVar
from urllib.parse import quote
from uuid import UUID

import httpx2

from shared.errors import (
    Conflict,
    InvalidRequest,
    PlacewiseError,
    TooManyRequests,
    Unavailable,
    refusal,
)
from shared.ids import new_id

API = "/api/v1"
IDEMPOTENCY_KEY = "Idempotency-Key"
FINISHED = ("succeeded", "failed", "cancelled")
POLL_SECONDS = 20.0  # one long poll
TIMEOUT_SECONDS = 90.0  # of one call: longer than the longest wait that a server grants
READ_BYTES = 256 * 1024
RETRY_SECONDS = 0.5  # where the server has not said how long
MOST_RETRY_SECONDS = 300.0  # whatever it says

Json = dict[str, Any]
Answer = TypeVar("Answer")
OnWait = Callable[[PlacewiseError, float], object]
"""Told of each wait before it begins: why, and how many seconds."""


class Client:
    """One server and one map. Thread-safe; close it, or use it as a context manager."""

    def __init__(
        self,
        url: str,
        map_name: str | None = None,
        key: str | None = None,
        *,
        patience_seconds: float = 0.0,
        on_wait: OnWait = lambda error, seconds: None,
    ) -> None:
        """`key` is what a server beyond loopback wants; others don't look at it.

        A call is repeated for `patience_seconds` while the server is away or can't do it (503,
        507). One that says when to come again (429) is obeyed for as long as it says so: it works,
        and has too much to do. 0 repeats nothing.

        Raises InvalidRequest (`bad_key`) for a key that no header can carry.
        """
        if key is not None and not (key.isascii() and key.isprintable()):
            raise InvalidRequest("bad_key", "A key is made of printable ASCII characters.")
        if not url.startswith(("http://", "https://")):
            raise InvalidRequest(
                "bad_address", f"{url!r} is no address such as http://127.0.0.1:8000."
            )
        self.url = url.rstrip("/")
        self._patience_seconds = patience_seconds
        self._on_wait = on_wait
        self._http = httpx2.Client(
            base_url=self.url,
            timeout=TIMEOUT_SECONDS,
            params={"map": map_name} if map_name else None,
            headers={"Authorization": f"Bearer {key}"} if key else None,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    def patient(self, patience_seconds: float, on_wait: OnWait) -> Client:
        """The same client with more patience, over the same connections."""
        other = copy.copy(self)
        other._patience_seconds, other._on_wait = patience_seconds, on_wait
        return other

    def upload(self, photo: Path, filename: str | None = None, **fields: Any) -> Json:
        """Store a photo; `fields` are the form's (`latitude`, `longitude`, `place`, ...).

        It is called `filename`, or as its file is.
        """
        said = {name: str(value) for name, value in fields.items() if value is not None}
        return self._send_file("/upload", photo, filename, data=said)

    def upload_direct(self, photo: Path, filename: str | None = None, **fields: Any) -> Json:
        """`upload` past the server, straight to its bucket; `fields` as JSON values.

        Raises Conflict (`no_direct_uploads`) where the server keeps photos in a folder.
        """
        with _opened(photo) as file:
            digest, size = hashlib.sha256(), 0
            while piece := file.read(READ_BYTES):
                digest.update(piece)
                size += len(piece)
            about = {
                "filename": filename or _name_of(photo),
                "file_size": size,
                "sha256": digest.hexdigest(),
            }
            begun = self._call("POST", "/uploads/presign", json={**about, **_given(**fields)})
            self._repeat(lambda: self._put(begun, file))
        return self._call("POST", begun["complete_url"].removeprefix(API))

    def upload_archive(
        self, archive: Path, on_sent: Callable[[int], object] = lambda sent_bytes: None
    ) -> Json:
        """Start a batch with the photos of a zip or tar; `on_sent` sees the bytes sent so far."""
        try:
            with _Watched(archive.open("rb"), on_sent) as opened:
                name = os.fsencode(archive.name).decode("utf-8", "replace")
                return self._call("POST", "/upload/batch", files={"archive": (name, opened)})
        except OSError as error:
            raise _unreadable(archive, error) from error

    def upload_files(self, photos: Sequence[Path], manifest: Sequence[Json] = ()) -> Json:
        """Start a batch with these photos; each line of the manifest has a `filename` and the
        form's fields."""
        with contextlib.ExitStack() as opened:
            files: list[tuple[str, Any]] = []
            for photo in photos:
                try:
                    file = opened.enter_context(photo.open("rb"))
                except OSError as error:
                    raise _unreadable(photo, error) from error
                files.append(("file", (photo.name, file)))
            if manifest:
                files.append(("manifest", ("manifest.jsonl", _as_lines(manifest))))
            return self._call("POST", "/upload/batch", files=files)

    def import_objects(self, manifest: Sequence[Json]) -> Json:
        """Start a batch with objects of the server's store; each line has a `key` and the form's
        fields."""
        headers = {"Content-Type": "application/x-ndjson"}
        return self._call("POST", "/upload/batch", content=_as_lines(manifest), headers=headers)

    def batch_items(self, job_id: UUID | str, *states: str) -> Iterator[Json]:
        """The photos of a batch that are in one of the states, or all of them."""
        cursor: str | None = None
        while True:
            params = _given(state=list(states) or None, cursor=cursor, limit=1000)
            page = self._call("GET", f"/jobs/{job_id}/items", params=params)
            yield from page["items"]
            cursor = page["next_cursor"]
            if cursor is None:
                return

    def similar_to_file(
        self,
        photo: Path,
        top_k: int = 10,
        min_score: float | None = None,
        wait_seconds: int = 60,
        rerank: int | None = None,
        explain: bool = False,
        **filters: Any,
    ) -> Json:
        """The photos most similar to one that is not stored; the rest as in `similar_to`."""
        params = _given(
            top_k=top_k,
            min_score=min_score,
            rerank=rerank,
            explain=explain or None,
            **filters,
        )
        answer = self._send_file(
            "/similarity",
            photo,
            params=params,
            headers={"Prefer": f"wait={wait_seconds}"},
        )
        return self._result_of(answer)

    def similar_to(
        self,
        file_id: UUID | str,
        top_k: int = 10,
        min_score: float | None = None,
        rerank: int | None = None,
        explain: bool = False,
        **filters: Any,
    ) -> Json:
        """The photos most similar to a stored one, of those that pass the filters: `near`
        ("LAT,LON,RADIUS_M"), `box` ("S,W,N,E"), `captured_after`, `captured_before`, `place`,
        `tags` and `ids` (separated by commas); `word_weights=False` ranks by the plain cosine.
        The first `rerank` of them are compared patch by patch; `explain` says of each what makes
        it similar."""
        params = _given(
            top_k=top_k,
            min_score=min_score,
            rerank=rerank,
            explain=explain or None,
            **filters,
        )
        return self._result_of(self._call("POST", f"/similarity/{file_id}", params=params))

    def _result_of(self, answer: Json) -> Json:
        """The answer itself, waited for where it is a job's: one job may lead to another."""
        while "result_url" in answer:
            self.wait_for(answer["job_id"])
            answer = self._call("GET", answer["result_url"].removeprefix(API))
        return answer

    def job(self, job_id: UUID | str, wait_seconds: float = 0) -> Json:
        return self._call("GET", f"/jobs/{job_id}", params={"wait": wait_seconds})

    def wait_for(
        self,
        job_id: UUID | str,
        on_progress: Callable[[Json], object] = lambda job: None,
        poll_seconds: float = POLL_SECONDS,
    ) -> Json:
        """The job once it has ended; `on_progress` sees it after every poll."""
        while True:
            job = self.job(job_id, wait_seconds=poll_seconds)
            on_progress(job)
            if job["state"] in FINISHED:
                return job

    def photo(self, file_id: UUID | str) -> Json:
        return self._call("GET", f"/uploads/{file_id}")

    def patch_photo(self, file_id: UUID | str, **fields: Any) -> Json:
        return self._call("PATCH", f"/uploads/{file_id}", json=fields)

    def delete_photo(self, file_id: UUID | str) -> Json:
        return self._call("DELETE", f"/uploads/{file_id}")

    def search(self, **filters: Any) -> Json:
        """Photos by what is known of them; see `GET /search`."""
        return self._call("GET", "/search", params=_given(**filters))

    def fit_vocabulary(self, **wanted: int) -> Json:
        """Start fitting; `clusters`, `sample` and `seed` may be given."""
        return self._call("POST", "/vocabularies", json=wanted)

    def import_vocabulary(self, file: Path) -> Json:
        """Start switching to the vocabulary in a `.npz` or `.npy` file."""
        return self._send_file("/vocabularies/import", file)

    def vocabulary_file(self, vocabulary_id: UUID | str) -> bytes:
        """A vocabulary as a file that `import_vocabulary` takes: `.npz` (it begins with `PK`), or
        `.npy` where no one knows what it was learnt with."""
        path = f"{API}/vocabularies/{vocabulary_id}/file"
        return self._repeat(lambda: self._ask(self._http, "GET", path).content)

    def vocabularies(self) -> list[Json]:
        found: Any = self._call("GET", "/vocabularies")
        return list(found)

    def start_generation(
        self,
        *,
        vocabulary_id: UUID | str | None = None,
        pca: int | None = None,
        extractor: str | None = None,
    ) -> Json:
        """Start switching to a vocabulary that the map has, to descriptors of `pca` dimensions, or
        to another extractor; with none, to whole ones of an extractor without vocabulary."""
        wanted = _given(
            vocabulary_id=vocabulary_id and str(vocabulary_id), pca=pca, extractor=extractor
        )
        return self._call("POST", "/generations", json=wanted)

    def generations(self) -> list[Json]:
        found: Any = self._call("GET", "/generations")
        return list(found)

    def evaluate(self, **wanted: int) -> Json:
        """Start an evaluation of the map; `sample` and `seed` may be given."""
        return self._call("POST", "/evaluations", json=wanted)

    def learn_word_weights(self, generation_id: UUID | str, **wanted: int) -> Json:
        """Start learning the weights of the active generation's words; `sample` and `seed` may be
        given."""
        return self._call("POST", f"/generations/{generation_id}/word-weights", json=wanted)

    def word_weights(self, generation_id: UUID | str) -> Json:
        """What the map's places have taught of the generation's words."""
        return self._call("GET", f"/generations/{generation_id}/word-weights")

    def evaluations(self, limit: int = 50) -> list[Json]:
        """The map's evaluations, newest first."""
        found: list[Json] = self._call("GET", "/evaluations", params={"limit": limit})[
            "evaluations"
        ]
        return found

    def searches(self, limit: int = 50) -> list[Json]:
        """What was asked, newest first."""
        found: list[Json] = self._call("GET", "/searches", params={"limit": limit})["searches"]
        return found

    def maps(self) -> list[Json]:
        """Every map of the server."""
        found: Any = self._call("GET", "/maps")
        return list(found)

    def create_map(self, name: str, extractor: str | None = None) -> Json:
        return self._call("POST", "/maps", json=_given(name=name, extractor=extractor))

    def delete_map(self, name: str) -> Json:
        """Delete a map with all its photos."""
        return self._call("DELETE", f"/maps/{quote(name, safe='')}")

    def add_model(
        self,
        checkpoint: Path,
        name: str,
        *,
        licence: str | None = None,
        note: str | None = None,
        on_sent: Callable[[int], object] = lambda sent_bytes: None,
    ) -> Json:
        """Start adding a checkpoint as the model `name`; `on_sent` sees the bytes sent so far."""
        said = _given(name=name, licence=licence, note=note)
        with _opened(checkpoint) as opened:
            files = {"file": (_name_of(checkpoint), _Watched(opened, on_sent))}
            return self._call("POST", "/models", opened, files=files, data=said)

    def models(self) -> list[Json]:
        """The models that were added."""
        found: list[Json] = self._call("GET", "/models")["models"]
        return found

    def remove_model(self, name: str) -> Json:
        return self._call("DELETE", f"/models/{quote(name, safe='')}")

    def stats(self) -> Json:
        return self._call("GET", "/database/stats")

    def keys(self) -> list[Json]:
        """Every key of the server, for an admin; the keys themselves are shown to nobody."""
        found: Any = self._call("GET", "/keys")
        return list(found)

    def create_key(self, name: str, scopes: Sequence[str], **limits: Any) -> Json:
        """A new key: `key` of the answer is shown this once. `limits` are those of POST /keys."""
        wanted = {"name": name, "scopes": list(scopes), **_given(**limits)}
        return self._call("POST", "/keys", json=wanted)

    def revoke_key(self, key_id: str) -> Json:
        return self._call("DELETE", f"/keys/{key_id}")

    def _send_file(self, path: str, file: Path, called: str | None = None, **options: Any) -> Json:
        with _opened(file) as opened:
            files = {"file": (called or _name_of(file), opened)}
            return self._call("POST", path, opened, files=files, **options)

    def _call(self, method: str, path: str, body: BinaryIO | None = None, **options: Any) -> Json:
        """One call of the API, repeated as patience allows; `body` is read from its begin."""
        if method == "POST" and self._patience_seconds:
            key = {IDEMPOTENCY_KEY: str(new_id())}
            options["headers"] = {**options.get("headers", {}), **key}

        def once() -> Json:
            if body is not None:
                body.seek(0)
            answer = self._ask(self._http, method, f"{API}{path}", **options)
            found: Json = answer.json()
            return found

        return self._repeat(once)

    def _put(self, begun: Json, file: BinaryIO) -> None:
        """Send a direct upload's bytes to where the server has said: no key of ours goes there."""
        file.seek(0)
        with httpx2.Client(timeout=TIMEOUT_SECONDS) as http:
            self._ask(http, begun["method"], begun["url"], content=file, headers=begun["headers"])

    def _ask(self, http: httpx2.Client, method: str, url: str, **options: Any) -> httpx2.Response:
        """A successful answer; anything else as the error that it means."""
        try:
            answer = http.request(method, url, **options)
        except httpx2.TransportError as error:
            host = self.url if url.startswith("/") else httpx2.URL(url).host
            raise Unavailable(
                "server_unreachable",
                f"No Placewise answers at {host} ({type(error).__name__}). Is it running?",
            ) from error
        if answer.is_success:
            return answer
        refused = refusal(answer.status_code, answer.text)
        after = answer.headers.get("retry-after", "")
        if after.isdigit():  # a proxy may be the one who says it
            refused.extra.setdefault("retry_after_seconds", int(after))
        raise refused

    def _repeat(self, call: Callable[[], Answer]) -> Answer:
        deadline = time.monotonic() + self._patience_seconds
        while True:
            try:
                return call()
            except (Unavailable, TooManyRequests, Conflict) as error:
                late = time.monotonic() >= deadline
                if not self._patience_seconds or not _passes(error, late):
                    raise
                seconds = float(error.extra.get("retry_after_seconds", RETRY_SECONDS))
                seconds = min(max(seconds, RETRY_SECONDS), MOST_RETRY_SECONDS)
                self._on_wait(error, seconds)
                time.sleep(seconds)


def _passes(error: PlacewiseError, late: bool) -> bool:
    """Is it worth waiting for what the error speaks of to pass?"""
    if isinstance(error, TooManyRequests):
        return True
    if isinstance(error, Conflict):  # our own call, whose answer was lost, is still under way
        return error.code == "idempotency_key_in_use" and not late
    return not late


@contextlib.contextmanager
def _opened(file: Path) -> Iterator[BinaryIO]:
    try:
        with file.open("rb") as opened:
            yield opened
    except OSError as error:
        raise InvalidRequest("unreadable_file", f"Can't read {file}: {error.strerror}") from error


def _name_of(file: Path) -> str:
    return os.fsencode(file.name).decode("utf-8", "replace")


class _Watched(io.BufferedIOBase):
    """A file that tells how far it was read."""

    def __init__(self, file: BinaryIO, on_read: Callable[[int], object]) -> None:
        self._file = file
        self._on_read = on_read

    def read(self, size: int | None = -1) -> bytes:
        data = self._file.read(-1 if size is None else size)
        self._on_read(self._file.tell())
        return data

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def fileno(self) -> int:
        return self._file.fileno()

    def close(self) -> None:
        self._file.close()
        super().close()


def _given(**params: Any) -> Json:
    return {name: value for name, value in params.items() if value is not None}


def _as_lines(objects: Sequence[Json]) -> bytes:
    return b"".join(json.dumps(one).encode() + b"\n" for one in objects)


def _unreadable(file: Path, error: OSError) -> InvalidRequest:
    return InvalidRequest("unreadable_file", f"Can't read {file}: {error.strerror}")
