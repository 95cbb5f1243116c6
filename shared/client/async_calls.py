"""The calls of the HTTP API, as JSON.

`calls.py` is made of this file by `make client`: change this one.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote
from uuid import UUID

from shared.client.async_wire import AsyncTransport
from shared.client.sending import (
    API,
    FINISHED,
    POLL_SECONDS,
    Json,
    ReadProgressFile,
    drop_none,
    open_file,
    printable_name,
    size_and_sha256,
    to_jsonl,
    unreadable_file_error,
)


class AsyncClient(AsyncTransport):
    """Every call of one server and one map, answered with the API's JSON."""

    async def upload(self, photo: Path, filename: str | None = None, **fields: Any) -> Json:
        """Store a photo; `fields` are the form's (`latitude`, `longitude`, `place`, ...).

        It is called `filename`, or as its file is.
        """
        said = {name: str(value) for name, value in fields.items() if value is not None}
        return await self._send_file("/upload", photo, filename, data=said)

    async def upload_direct(self, photo: Path, filename: str | None = None, **fields: Any) -> Json:
        """`upload` past the server, straight to its bucket; `fields` as JSON values.

        Raises Conflict (`no_direct_uploads`) where the server keeps photos in a folder.
        """
        with open_file(photo) as file:
            size, sha256 = size_and_sha256(file)
            about = {
                "filename": filename or printable_name(photo),
                "file_size": size,
                "sha256": sha256,
            }
            begun = await self._call(
                "POST", "/uploads/presign", json={**about, **drop_none(**fields)}
            )
            await self._put(begun, file)
        return await self._call("POST", begun["complete_url"].removeprefix(API))

    async def upload_archive(
        self, archive: Path, on_sent: Callable[[int], object] = lambda sent_bytes: None
    ) -> Json:
        """Start a batch with the photos of a zip or tar; `on_sent` sees the bytes sent so far."""
        try:
            with ReadProgressFile(archive.open("rb"), on_sent) as open_file:
                files = {"archive": (printable_name(archive), open_file)}
                return await self._call("POST", "/upload/batch", open_file, files=files)
        except OSError as error:
            raise unreadable_file_error(archive, error) from error

    async def upload_files(self, photos: Sequence[Path], manifest: Sequence[Json] = ()) -> Json:
        """Start a batch with these photos; each line of the manifest has a `filename` and the
        form's fields."""
        with contextlib.ExitStack() as open_file:
            files: list[tuple[str, Any]] = []
            for photo in photos:
                try:
                    file = open_file.enter_context(photo.open("rb"))
                except OSError as error:
                    raise unreadable_file_error(photo, error) from error
                files.append(("file", (photo.name, file)))
            if manifest:
                files.append(("manifest", ("manifest.jsonl", to_jsonl(manifest))))
            return await self._call("POST", "/upload/batch", files=files)

    async def import_objects(self, manifest: Sequence[Json]) -> Json:
        """Start a batch with objects of the server's store; each line has a `key` and the form's
        fields."""
        return await self.import_manifest(to_jsonl(manifest))

    async def import_manifest(self, lines: bytes) -> Json:
        """`import_objects` with the lines as JSONL."""
        headers = {"Content-Type": "application/x-ndjson"}
        return await self._call("POST", "/upload/batch", content=lines, headers=headers)

    async def import_prefix(self, prefix: str) -> Json:
        """Start a batch with every photo of the server's store whose key begins with `prefix`."""
        return await self._call("POST", "/upload/batch", files={"prefix": (None, prefix)})

    def batch_items(self, job_id: UUID | str, *states: str) -> AsyncIterator[Json]:
        """The photos of a batch that are in one of the states, or all of them."""
        return self.each(f"/jobs/{job_id}/items", "items", state=list(states) or None)

    async def cancel_job(self, job_id: UUID | str) -> Json:
        return await self._call("POST", f"/jobs/{job_id}/cancel")

    async def retry_job(self, job_id: UUID | str) -> Json:
        """Queue a failed job again; of a batch, its failed items."""
        return await self._call("POST", f"/jobs/{job_id}/retry")

    async def similar_to_file(
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
        params = drop_none(
            top_k=top_k,
            min_score=min_score,
            rerank=rerank,
            explain=explain or None,
            **filters,
        )
        answer = await self._send_file(
            "/similarity",
            photo,
            params=params,
            headers={"Prefer": f"wait={wait_seconds}"},
        )
        return await self._result_of(answer)

    async def similar_to(
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
        params = drop_none(
            top_k=top_k,
            min_score=min_score,
            rerank=rerank,
            explain=explain or None,
            **filters,
        )
        return await self._result_of(
            await self._call("POST", f"/similarity/{file_id}", params=params)
        )

    async def _result_of(self, answer: Json) -> Json:
        """The answer itself, waited for where it is a job's: one job may lead to another."""
        while "result_url" in answer:
            await self.wait_for(answer["job_id"])
            answer = await self._call("GET", answer["result_url"].removeprefix(API))
        return answer

    async def job(self, job_id: UUID | str, wait_seconds: float = 0) -> Json:
        return await self._call("GET", f"/jobs/{job_id}", params={"wait": wait_seconds})

    async def wait_for(
        self,
        job_id: UUID | str,
        on_progress: Callable[[Json], object] = lambda job: None,
        poll_seconds: float = POLL_SECONDS,
    ) -> Json:
        """The job once it has ended; `on_progress` sees it after every poll."""
        while True:
            job = await self.job(job_id, wait_seconds=poll_seconds)
            on_progress(job)
            if job["state"] in FINISHED:
                return job

    async def photo(self, file_id: UUID | str) -> Json:
        return await self._call("GET", f"/uploads/{file_id}")

    async def image(self, file_id: UUID | str) -> bytes:
        """The photo's bytes as they were uploaded."""
        return await self._get_bytes(f"/uploads/{file_id}/image")

    async def patch_photo(self, file_id: UUID | str, **fields: Any) -> Json:
        return await self._call("PATCH", f"/uploads/{file_id}", json=fields)

    async def delete_photo(self, file_id: UUID | str) -> Json:
        return await self._call("DELETE", f"/uploads/{file_id}")

    async def search(self, **filters: Any) -> Json:
        """Photos by what is known of them; see `GET /search`."""
        return await self._call("GET", "/search", params=drop_none(**filters))

    async def fit_vocabulary(self, **wanted: int) -> Json:
        """Start fitting; `clusters`, `sample` and `seed` may be given."""
        return await self._call("POST", "/vocabularies", json=wanted)

    async def import_vocabulary(self, file: Path) -> Json:
        """Start switching to the vocabulary in a `.npz` or `.npy` file."""
        return await self._send_file("/vocabularies/import", file)

    async def vocabulary_file(self, vocabulary_id: UUID | str) -> bytes:
        """A vocabulary as a file that `start_vocabulary_import` takes: `.npz` (it begins with
        `PK`), or
        `.npy` where no one knows what it was learnt with."""
        return await self._get_bytes(f"/vocabularies/{vocabulary_id}/file")

    async def vocabularies(self) -> list[Json]:
        found: Any = await self._call("GET", "/vocabularies")
        return list(found)

    async def start_generation(
        self,
        *,
        vocabulary_id: UUID | str | None = None,
        pca: int | None = None,
        extractor: str | None = None,
    ) -> Json:
        """Start switching to a vocabulary that the map has, to descriptors of `pca` dimensions, or
        to another extractor; with none, to whole ones of an extractor without vocabulary."""
        wanted = drop_none(
            vocabulary_id=vocabulary_id and str(vocabulary_id), pca=pca, extractor=extractor
        )
        return await self._call("POST", "/generations", json=wanted)

    async def generations(self) -> list[Json]:
        found: Any = await self._call("GET", "/generations")
        return list(found)

    async def evaluate(self, **wanted: int) -> Json:
        """Start an evaluation of the map; `sample` and `seed` may be given."""
        return await self._call("POST", "/evaluations", json=wanted)

    async def learn_word_weights(self, generation_id: UUID | str, **wanted: int) -> Json:
        """Start learning the weights of the active generation's words; `sample` and `seed` may be
        given."""
        return await self._call("POST", f"/generations/{generation_id}/word-weights", json=wanted)

    async def word_weights(self, generation_id: UUID | str) -> Json:
        """What the map's places have taught of the generation's words."""
        return await self._call("GET", f"/generations/{generation_id}/word-weights")

    async def evaluations(self, limit: int = 50) -> list[Json]:
        """The map's evaluations, newest first."""
        page = await self._call("GET", "/evaluations", params={"limit": limit})
        found: list[Json] = page["evaluations"]
        return found

    async def searches(self, limit: int = 50) -> list[Json]:
        """What was asked, newest first."""
        page = await self._call("GET", "/searches", params={"limit": limit})
        found: list[Json] = page["searches"]
        return found

    async def export_descriptors(
        self,
        generation_id: UUID | str,
        file: BinaryIO,
        on_received: Callable[[int], object] = lambda received_bytes: None,
    ) -> None:
        """Write a tar with `descriptors.npy`, `names.txt` and `photos.csv` to `file`."""
        await self._fetch(f"/generations/{generation_id}/descriptors", file, on_received)

    async def maps(self) -> list[Json]:
        """Every map of the server."""
        found: Any = await self._call("GET", "/maps")
        return list(found)

    async def create_map(self, name: str, extractor: str | None = None) -> Json:
        return await self._call("POST", "/maps", json=drop_none(name=name, extractor=extractor))

    async def delete_map(self, name: str) -> Json:
        """Delete a map with all its photos."""
        return await self._call("DELETE", f"/maps/{quote(name, safe='')}")

    async def add_model(
        self,
        checkpoint: Path,
        name: str,
        *,
        licence: str | None = None,
        note: str | None = None,
        on_sent: Callable[[int], object] = lambda sent_bytes: None,
    ) -> Json:
        """Start adding a checkpoint as the model `name`; `on_sent` sees the bytes sent so far."""
        said = drop_none(name=name, licence=licence, note=note)
        with open_file(checkpoint) as file:
            files = {"file": (printable_name(checkpoint), ReadProgressFile(file, on_sent))}
            return await self._call("POST", "/models", file, files=files, data=said)

    async def models(self) -> list[Json]:
        """The models that were added."""
        answer = await self._call("GET", "/models")
        return list(answer["models"])

    async def remove_model(self, name: str) -> Json:
        return await self._call("DELETE", f"/models/{quote(name, safe='')}")

    async def keys(self) -> list[Json]:
        """Every key of the server, for an admin; the keys themselves are shown to nobody."""
        found: Any = await self._call("GET", "/keys")
        return list(found)

    async def create_key(self, name: str, scopes: Sequence[str], **limits: Any) -> Json:
        """A new key: `key` of the answer is shown this once. `limits` are those of POST /keys."""
        wanted = {"name": name, "scopes": list(scopes), **drop_none(**limits)}
        return await self._call("POST", "/keys", json=wanted)

    async def revoke_key(self, key_id: str) -> Json:
        return await self._call("DELETE", f"/keys/{key_id}")

    async def health(self) -> Json:
        """The state of each part; Unavailable where one is away."""
        return await self._call("GET", "/health")

    async def stats(self) -> Json:
        return await self._call("GET", "/database/stats")
