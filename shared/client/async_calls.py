"""The calls of the HTTP API, returning JSON.

`calls.py` is generated from this file by `make client`. Edit this file.
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
    """Client of one server and one map. All calls return the API's JSON."""

    async def upload(self, photo: Path, filename: str | None = None, **fields: Any) -> Json:
        """Upload a photo.

        Args:
            photo: The file.
            filename: Name to store; None for the file's own name.
            fields: Form fields of `POST /upload`: `latitude`, `longitude`, `place`, ...
        """
        data = {name: str(value) for name, value in fields.items() if value is not None}
        return await self._send_file("/upload", photo, filename, data=data)

    async def upload_direct(self, photo: Path, filename: str | None = None, **fields: Any) -> Json:
        """Upload a photo directly to the server's bucket with a presigned URL.

        The arguments are those of `upload`; `fields` are JSON values.

        Raises:
            Conflict: `no_direct_uploads` if the server stores photos in a folder.
        """
        with open_file(photo) as file:
            size, sha256 = size_and_sha256(file)
            file_info = {
                "filename": filename or printable_name(photo),
                "file_size": size,
                "sha256": sha256,
            }
            upload = await self._call(
                "POST", "/uploads/presign", json={**file_info, **drop_none(**fields)}
            )
            await self._put(upload, file)
        return await self._call("POST", upload["complete_url"].removeprefix(API))

    async def upload_archive(
        self, archive: Path, on_sent: Callable[[int], object] = lambda sent_bytes: None
    ) -> Json:
        """Start a batch upload of a zip or tar; `on_sent` receives the bytes sent so far."""
        try:
            with ReadProgressFile(archive.open("rb"), on_sent) as stream:
                files = {"archive": (printable_name(archive), stream)}
                return await self._call("POST", "/upload/batch", stream, files=files)
        except OSError as error:
            raise unreadable_file_error(archive, error) from error

    async def upload_files(self, photos: Sequence[Path], manifest: Sequence[Json] = ()) -> Json:
        """Start a batch upload of photo files.

        Each manifest entry contains a `filename` and form fields of `upload`.
        """
        with contextlib.ExitStack() as stack:
            files: list[tuple[str, Any]] = []
            for photo in photos:
                try:
                    file = stack.enter_context(photo.open("rb"))
                except OSError as error:
                    raise unreadable_file_error(photo, error) from error
                files.append(("file", (photo.name, file)))
            if manifest:
                files.append(("manifest", ("manifest.jsonl", to_jsonl(manifest))))
            return await self._call("POST", "/upload/batch", files=files)

    async def import_objects(self, manifest: Sequence[Json]) -> Json:
        """Start a batch import of objects in the server's store.

        Each manifest entry contains an object `key` and form fields of `upload`.
        """
        return await self.import_manifest(to_jsonl(manifest))

    async def import_manifest(self, lines: bytes) -> Json:
        """Start a batch import like `import_objects`, with the manifest as JSONL."""
        headers = {"Content-Type": "application/x-ndjson"}
        return await self._call("POST", "/upload/batch", content=lines, headers=headers)

    async def import_prefix(self, prefix: str) -> Json:
        """Start a batch import of all photos in the server's store below a key prefix."""
        return await self._call("POST", "/upload/batch", files={"prefix": (None, prefix)})

    def batch_items(self, job_id: UUID | str, *states: str) -> AsyncIterator[Json]:
        """Iterate over the items of a batch, optionally only those in the given states."""
        return self.each(f"/jobs/{job_id}/items", "items", state=list(states) or None)

    async def cancel_job(self, job_id: UUID | str) -> Json:
        """Cancel a job."""
        return await self._call("POST", f"/jobs/{job_id}/cancel")

    async def retry_job(self, job_id: UUID | str) -> Json:
        """Queue a failed job again; for a batch, its failed items."""
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
        """Find the stored photos most similar to a file, which is not stored.

        The call waits up to `wait_seconds` for a synchronous response and otherwise polls the job.
        The other arguments are those of `similar_to`.
        """
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
        """Find the photos most similar to a stored one.

        Args:
            file_id: ID of the query photo.
            top_k: Maximum number of results.
            min_score: Minimum cosine similarity.
            rerank: Number of first results to rerank by comparing patches.
            explain: Add explanations to the results.
            filters: `near` ("LAT,LON,RADIUS_M"), `box` ("S,W,N,E"), `captured_after`,
                `captured_before`, `place`, `place_under`, `tags` and `ids` (comma-separated);
                `word_weights=False` ranks by the unweighted cosine similarity; `certainty` is the
                share of answers that must be right.
        """
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
        """Follow `result_url` until the result is available; one job may lead to another."""
        while "result_url" in answer:
            await self.wait_for(answer["job_id"])
            answer = await self._call("GET", answer["result_url"].removeprefix(API))
        return answer

    async def job(self, job_id: UUID | str, wait_seconds: float = 0) -> Json:
        """Get a job; with `wait_seconds`, wait that long for it to end (long polling)."""
        return await self._call("GET", f"/jobs/{job_id}", params={"wait": wait_seconds})

    async def wait_for(
        self,
        job_id: UUID | str,
        on_progress: Callable[[Json], object] = lambda job: None,
        poll_seconds: float = POLL_SECONDS,
    ) -> Json:
        """Wait until a job ends; `on_progress` is called with the job after every poll."""
        while True:
            job = await self.job(job_id, wait_seconds=poll_seconds)
            on_progress(job)
            if job["state"] in FINISHED:
                return job

    async def photo(self, file_id: UUID | str) -> Json:
        """Get a stored photo's metadata and state."""
        return await self._call("GET", f"/uploads/{file_id}")

    async def image(self, file_id: UUID | str) -> bytes:
        """Download the original bytes of a photo."""
        return await self._get_bytes(f"/uploads/{file_id}/image")

    async def patch_photo(self, file_id: UUID | str, **fields: Any) -> Json:
        """Update a photo's metadata: omitted fields are unchanged, None clears a field."""
        return await self._call("PATCH", f"/uploads/{file_id}", json=fields)

    async def delete_photo(self, file_id: UUID | str) -> Json:
        """Delete a photo."""
        return await self._call("DELETE", f"/uploads/{file_id}")

    async def search(self, **filters: Any) -> Json:
        """Search photos by metadata; for filters see `GET /search`."""
        return await self._call("GET", "/search", params=drop_none(**filters))

    async def fit_vocabulary(self, **options: int) -> Json:
        """Start fitting a vocabulary; options are `clusters`, `sample` and `seed`."""
        return await self._call("POST", "/vocabularies", json=options)

    async def import_vocabulary(self, file: Path) -> Json:
        """Start reindexing the map with a vocabulary from a `.npz` or `.npy` file."""
        return await self._send_file("/vocabularies/import", file)

    async def vocabulary_file(self, vocabulary_id: UUID | str) -> bytes:
        """Download a vocabulary file that `import_vocabulary` accepts.

        The format is `.npz` (starting with `PK`), or `.npy` if its provenance is unknown.
        """
        return await self._get_bytes(f"/vocabularies/{vocabulary_id}/file")

    async def vocabularies(self) -> list[Json]:
        """List the map's vocabularies, newest first."""
        response: Any = await self._call("GET", "/vocabularies")
        return list(response)

    async def start_generation(
        self,
        *,
        vocabulary_id: UUID | str | None = None,
        pca: int | None = None,
        extractor: str | None = None,
    ) -> Json:
        """Start a new generation of the map's descriptors.

        Args:
            vocabulary_id: One of the map's vocabularies.
            pca: Number of dimensions to reduce to by PCA whitening.
            extractor: Another extractor.

        Without arguments, PCA is undone for an extractor without a vocabulary.
        """
        params = drop_none(
            vocabulary_id=vocabulary_id and str(vocabulary_id), pca=pca, extractor=extractor
        )
        return await self._call("POST", "/generations", json=params)

    async def generations(self) -> list[Json]:
        """List the map's generations, newest first."""
        response: Any = await self._call("GET", "/generations")
        return list(response)

    async def evaluate(self, **options: int) -> Json:
        """Start an evaluation of the map; options are `sample` and `seed`."""
        return await self._call("POST", "/evaluations", json=options)

    async def learn_word_weights(self, generation_id: UUID | str, **options: int) -> Json:
        """Start fitting word weights of the active generation; options are `sample` and `seed`."""
        return await self._call("POST", f"/generations/{generation_id}/word-weights", json=options)

    async def word_weights(self, generation_id: UUID | str) -> Json:
        """Get the word weights that were fitted for a generation."""
        return await self._call("GET", f"/generations/{generation_id}/word-weights")

    async def evaluations(self, limit: int = 50) -> list[Json]:
        """List the map's evaluations, newest first."""
        page = await self._call("GET", "/evaluations", params={"limit": limit})
        evaluations: list[Json] = page["evaluations"]
        return evaluations

    async def searches(self, limit: int = 50) -> list[Json]:
        """List the search history, newest first."""
        page = await self._call("GET", "/searches", params={"limit": limit})
        searches: list[Json] = page["searches"]
        return searches

    async def export_descriptors(
        self,
        generation_id: UUID | str,
        file: BinaryIO,
        on_received: Callable[[int], object] = lambda received_bytes: None,
    ) -> None:
        """Download a tar with `descriptors.npy`, `names.txt` and `photos.csv` into a file."""
        await self._fetch(f"/generations/{generation_id}/descriptors", file, on_received)

    async def maps(self) -> list[Json]:
        """List the maps of the server."""
        response: Any = await self._call("GET", "/maps")
        return list(response)

    async def create_map(
        self, name: str, extractor: str | None = None, *, place_labels_are_paths: bool = False
    ) -> Json:
        """Create a map; `extractor` defaults to the server's setting."""
        body = drop_none(
            name=name,
            extractor=extractor,
            place_labels_are_paths=place_labels_are_paths or None,
        )
        return await self._call("POST", "/maps", json=body)

    async def update_map(self, name: str, *, place_labels_are_paths: bool) -> Json:
        """Change whether `/` separates the levels of the map's place labels."""
        body = {"place_labels_are_paths": place_labels_are_paths}
        return await self._call("PATCH", f"/maps/{quote(name, safe='')}", json=body)

    async def delete_map(self, name: str) -> Json:
        """Delete a map and all its photos."""
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
        """Start adding a checkpoint as a model; `on_sent` receives the bytes sent so far."""
        data = drop_none(name=name, licence=licence, note=note)
        with open_file(checkpoint) as file:
            files = {"file": (printable_name(checkpoint), ReadProgressFile(file, on_sent))}
            return await self._call("POST", "/models", file, files=files, data=data)

    async def models(self) -> list[Json]:
        """List the added models."""
        answer = await self._call("GET", "/models")
        return list(answer["models"])

    async def remove_model(self, name: str) -> Json:
        """Remove a model that no map uses."""
        return await self._call("DELETE", f"/models/{quote(name, safe='')}")

    async def keys(self) -> list[Json]:
        """List the API keys of the server, without their secrets (admin only)."""
        response: Any = await self._call("GET", "/keys")
        return list(response)

    async def create_key(self, name: str, scopes: Sequence[str], **limits: Any) -> Json:
        """Create an API key; the field `key` of the response is shown only once.

        `limits` are the optional fields of `POST /keys`.
        """
        params = {"name": name, "scopes": list(scopes), **drop_none(**limits)}
        return await self._call("POST", "/keys", json=params)

    async def revoke_key(self, key_id: str) -> Json:
        """Revoke an API key."""
        return await self._call("DELETE", f"/keys/{key_id}")

    async def health(self) -> Json:
        """Get the health of each part.

        Raises:
            Unavailable: A part is unavailable.
        """
        return await self._call("GET", "/health")

    async def stats(self) -> Json:
        """Get statistics of the map."""
        return await self._call("GET", "/database/stats")
