"""The asynchronous client with typed responses."""

from __future__ import annotations

import contextlib
import time
from collections.abc import AsyncIterator, Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO, Literal
from urllib.parse import quote
from uuid import UUID

from placewise import answers
from placewise.async_transport import AsyncTransport
from placewise.protocol import (
    API,
    POLL_SECONDS,
    Json,
    drop_none,
    open_file,
    printable_name,
    to_jsonl,
    to_text,
)
from shared.errors import Unavailable, Unprocessable

HEADER_BYTES = 256 * 1024
Id = UUID | str
Work = answers.Uploaded | answers.Started | answers.Job | UUID | str
"""A job: the response that started it, the job itself, or its ID."""


class AsyncClient(AsyncTransport):
    """Client of one server and one map."""

    async def upload(
        self, /, photo: str | Path | BinaryIO, filename: str | None = None, **fields: Any
    ) -> answers.Uploaded:
        """Upload a photo, streamed from its file.

        Args:
            photo: The file: its path, or open for reading bytes, such as io.BytesIO.
            filename: Name to store; None for the name of the path.
            fields: Form fields: `latitude` and `longitude` (degrees), `altitude` (metres),
                `heading`, `captured_at`, `place`, `tags`, `metadata`, `role`, `relative_path`.

        Raises:
            Conflict: `photo_differs` if the map contains the same image with other metadata.
            UnsupportedMedia: The file is not a supported image.
            TooLarge: The file exceeds the server's limit.
            Unprocessable: A field or the image is invalid.
        """
        return answers.Uploaded(**await self._send_file("/upload", photo, filename, fields))

    async def upload_files(
        self, photos: Sequence[str | Path], manifest: Sequence[Json] = ()
    ) -> answers.BatchStarted:
        """Start a batch upload of photo files.

        Each manifest entry contains a `filename` and fields of `upload`.
        """
        with contextlib.ExitStack() as stack:
            files: list[tuple[str, Any]] = [
                ("file", (printable_name(Path(photo)), stack.enter_context(open_file(Path(photo)))))
                for photo in photos
            ]
            if manifest:
                files.append(("manifest", ("manifest.jsonl", to_jsonl(manifest))))
            return await self._start_batch(files=files)

    async def import_objects(self, manifest: Sequence[Json] | bytes) -> answers.BatchStarted:
        """Start a batch import of objects in the server's store.

        Each manifest entry contains an object `key` and fields of `upload`; bytes are JSONL.
        """
        data = manifest if isinstance(manifest, bytes) else to_jsonl(manifest)
        return await self._start_batch(files={"manifest": ("manifest.jsonl", data)})

    async def sync_library(self, *, every_hours: int | None = None) -> answers.Started:
        """Bring the map up to date with the photo library of the server's settings.

        Args:
            every_hours: Hours between the end of a run and the next; None: once.
        """
        body = {"every_hours": every_hours}
        return answers.Started(**await self._call("POST", "/library-syncs", json=body))

    async def import_prefix(self, prefix: str) -> answers.BatchStarted:
        """Start a batch import of all photos in the server's store below a key prefix."""
        return await self._start_batch(files={"prefix": (None, prefix)})

    async def _start_batch(self, **body: Any) -> answers.BatchStarted:
        return answers.BatchStarted(**await self._call("POST", "/upload/batch", **body))

    def batch_items(self, work: Work, *states: str) -> AsyncIterator[answers.BatchItem]:
        """Iterate over the items of a batch, optionally only those in the given states."""
        path = f"/jobs/{_job_id(work)}/items"
        return self._iterate(answers.BatchItem, path, "items", state=list(states) or None)

    async def similar(
        self,
        /,
        photo: str | Path | BinaryIO | answers.Photo | UUID,
        top_k: int = 10,
        min_score: float | None = None,
        matches: int | None = None,
        rerank: int | None = None,
        explain: bool = False,
        pose: bool = False,
        focal_length: float | None = None,
        wait_seconds: int = 60,
        **filters: Any,
    ) -> answers.Similar:
        """Find the most similar photos and estimate the place.

        Args:
            photo: A file (its path, or open for reading bytes), which is not stored, or a stored
                photo (a Photo or its UUID).
            top_k: Maximum number of results.
            min_score: Minimum cosine similarity.
            matches: Number of first results whose local features are matched with the photo's, 0 to
                50; each of them has `inliers`. By default, the map decides.
            rerank: Number of first results to match and to order by their inliers.
            explain: Add the matching points (`pairs`) to the results that are matched.
            pose: Compute where the camera stood and looked, with radii; takes a reconstruction.
            focal_length: Focal length of the camera as a multiple of the photo's longer side; by
                default that of the EXIF, or else it is estimated.
            wait_seconds: How long the server may hold the call (`Prefer: wait`) before the client
                polls the job instead.
            filters: `near` ("LAT,LON,RADIUS_M"), `box` ("S,W,N,E"), `captured_after`,
                `captured_before`, `place`, `place_under`, `tags`, `tags_like` and `ids`
                (lists or comma-separated); `certainty` is the share of answers that must be right;
                `guarantee` instead that of all queries that may get a wrong answer;
                `elsewhere` the share of queries that are from elsewhere than the map;
                `history=False` leaves the search out of the search history.
        """
        options: Json = {
            "params": drop_none(
                top_k=top_k,
                min_score=min_score,
                matches=matches,
                rerank=rerank,
                explain=explain or None,
                pose=pose or None,
                focal_length=focal_length,
                **to_text(**filters),
            ),
            "headers": {"Prefer": f"wait={wait_seconds}"},
        }
        if isinstance(photo, (answers.Photo, UUID)):
            file_id = photo.image_id if isinstance(photo, answers.Photo) else photo
            answer = await self._call("POST", f"/similarity/{file_id}", **options)
        else:
            answer = await self._send_file("/similarity", photo, **options)
        if "result_url" in answer:
            async for _ in self.watch(answer["job_id"]):
                pass
            answer = await self._call("GET", answer["result_url"].removeprefix(API))
        return answers.Similar(**answer)

    async def read_header(self, photo: str | Path) -> answers.PhotoHeader:
        """Read when, where and by which camera a photo was taken from the begin of its file.

        Raises:
            Unprocessable: `undecodable_photo`.
        """
        with open_file(Path(photo)) as file:
            begin = file.read(HEADER_BYTES)
        headers = {"Content-Type": "application/octet-stream"}
        return answers.PhotoHeader(
            **await self._call("POST", "/photo-headers", content=begin, headers=headers)
        )

    async def propose_positions(
        self, /, photos: Sequence[Json], track: Sequence[Json] = (), **options: Any
    ) -> list[answers.Proposal]:
        """Propose where photos were taken that have no coordinates. Nothing is stored.

        Args:
            photos: The photos of a folder, with and without coordinates: `name`, and the fields of
                `read_header` as JSON; those without coordinates may have what `similar` answered,
                as `search` with `similar`, `circles` and `not_in_map`.
            track: Points of a GPX track: `time`, `latitude`, `longitude`.
            options: `radius_m`, `motion` (`walk`, `bicycle`, `car`, `train`), `together`.

        Returns:
            The proposals for the photos without coordinates, in their order.
        """
        body = {"photos": list(photos), "track": list(track), **options}
        answer = await self._call("POST", "/positions", json=body)
        return [answers.Proposal(**each) for each in answer["proposals"]]

    async def begin_track(
        self, *, motion: str | None = None, max_speed_mps: float | None = None
    ) -> answers.Track:
        """Begin a track: a sequence of frames that is followed through the map.

        Args:
            motion: How the camera moves: `walk`, `bicycle`, `car` (the default) or `train`.
            max_speed_mps: Its maximum speed in m/s, instead of `motion`.
        """
        body = drop_none(motion=motion, max_speed_mps=max_speed_mps)
        return answers.Track(**await self._call("POST", "/tracks", json=body))

    async def add_frame(
        self,
        /,
        track_id: Id,
        photo: str | Path | BinaryIO,
        captured_at: datetime | str,
        *,
        wait: bool = True,
        expected_version: int | None = None,
        **measured: float | None,
    ) -> answers.TrackFrame:
        """Add a frame to a track. The photo is not stored in the map.

        Args:
            captured_at: When it was taken, or that in ISO 8601; unique in the track. Without an
                offset it is UTC.
            wait: Wait for the state; False returns as soon as the frame is stored.
            expected_version: Version that the track must have, such as `version` of the frame
                before.
            measured: `latitude`, `longitude` (degrees) and `accuracy_m` of a position;
                `distance_m` and `distance_accuracy_m`, also `turn_degrees` and
                `turn_accuracy_degrees`, of odometry since the frame before.

        Raises:
            Conflict: `track_changed`, `frame_differs`, `frame_too_late` or `track_full`.
            Unprocessable: A field or the image is invalid.
        """
        answer = await self._send_file(
            f"/tracks/{track_id}/frames",
            photo,
            fields={"captured_at": captured_at, "expected_version": expected_version, **measured},
            headers={"Prefer": f"wait={POLL_SECONDS:g}"} if wait else {},
        )
        frame = answers.TrackFrame(**answer)
        while wait and frame.status == "pending":
            frame = await self.track_frame(track_id, frame.frame_id, wait_seconds=POLL_SECONDS)
        return frame

    async def track_frame(
        self, track_id: Id, frame_id: Id, *, wait_seconds: float = 0
    ) -> answers.TrackFrame:
        """Get a frame of a track; with `wait_seconds`, wait that long until it is applied."""
        path = f"/tracks/{track_id}/frames/{frame_id}"
        headers = {"Prefer": f"wait={wait_seconds:.0f}"}
        return answers.TrackFrame(**await self._call("GET", path, headers=headers))

    async def track(self, track_id: Id, *, smoothed: bool = False) -> answers.OneTrack:
        """Get a track with all frames; `smoothed` uses the later frames for each state, too."""
        params = drop_none(smoothed=smoothed or None)
        return answers.OneTrack(**await self._call("GET", f"/tracks/{track_id}", params=params))

    def tracks(self) -> AsyncIterator[answers.Track]:
        """Iterate over the tracks of the map, newest first."""
        return self._iterate(answers.Track, "/tracks", "tracks")

    async def delete_track(self, track_id: Id) -> answers.DeletedTrack:
        """Delete a track with its frames."""
        return answers.DeletedTrack(**await self._call("DELETE", f"/tracks/{track_id}"))

    async def job(self, work: Work, wait_seconds: float = 0) -> answers.Job:
        """Get a job; with `wait_seconds`, wait that long for it to end (long polling)."""
        path = f"/jobs/{_job_id(work)}"
        return answers.Job(**await self._call("GET", path, params={"wait": wait_seconds}))

    def jobs(self, /, **filters: Any) -> AsyncIterator[answers.Job]:
        """Iterate over the map's jobs, newest first; filters are `state` and `kind`."""
        return self._iterate(answers.Job, "/jobs", "jobs", **filters)

    async def watch(
        self,
        work: Work,
        timeout_seconds: float | None = None,
        poll_seconds: float = POLL_SECONDS,
    ) -> AsyncIterator[answers.Job]:
        """Poll a job and iterate over its states; the last one is its end, also if it failed.

        Args:
            timeout_seconds: Maximum time to wait; None for no limit.
            poll_seconds: Maximum duration of a poll, which ends early when the job ends.

        Raises:
            Unavailable: `job_unfinished` if the timeout expires.
        """
        deadline = None if timeout_seconds is None else time.monotonic() + timeout_seconds
        while True:
            remaining = poll_seconds if deadline is None else deadline - time.monotonic()
            job = await self.job(work, max(0.0, min(remaining, poll_seconds)))
            yield job
            if job.finished:
                return
            if deadline is not None and time.monotonic() >= deadline:
                raise Unavailable(
                    "job_unfinished",
                    f"The job {job.job_id} is still {job.state} after {timeout_seconds:g} s.",
                )

    async def wait(
        self,
        work: Work,
        timeout_seconds: float | None = None,
        on_progress: Callable[[answers.Job], object] = lambda job: None,
        poll_seconds: float = POLL_SECONDS,
    ) -> answers.Job:
        """Wait until a job succeeds.

        Args:
            timeout_seconds: Maximum time to wait; None for no limit.
            on_progress: Called with the job after every poll.
            poll_seconds: Maximum duration of a poll, which ends early when the job ends.

        Raises:
            Unprocessable: The job failed (with the job's `code`) or was cancelled (`job_ended`).
            Unavailable: `job_unfinished` if the timeout expires.
        """
        async for job in self.watch(work, timeout_seconds, poll_seconds):
            on_progress(job)
        job.raise_for_failure()
        return job

    async def cancel(self, work: Work) -> answers.Job:
        """Cancel a job."""
        return answers.Job(**await self._call("POST", f"/jobs/{_job_id(work)}/cancel"))

    async def retry(self, work: Work) -> answers.Job:
        """Queue a failed or cancelled job again.

        For a batch: its failed and cancelled items whose bytes are still stored.
        """
        return answers.Job(**await self._call("POST", f"/jobs/{_job_id(work)}/retry"))

    async def photo(self, file_id: Id) -> answers.OnePhoto:
        """Get a stored photo's metadata and state."""
        return answers.OnePhoto(**await self._call("GET", f"/uploads/{file_id}"))

    async def image(self, file_id: Id) -> bytes:
        """Download the original bytes of a photo."""
        return await self._get_bytes(f"/uploads/{file_id}/image")

    def photos(self, /, **filters: Any) -> AsyncIterator[answers.Photo]:
        """Iterate over photos by metadata, newest first; for filters see `GET /search`."""
        return self._iterate(answers.Photo, "/search", "images", **to_text(**filters))

    async def patch_photo(self, /, file_id: Id, **fields: Any) -> answers.OnePhoto:
        """Update a photo's metadata: omitted fields are unchanged, None clears a field."""
        return answers.OnePhoto(**await self._call("PATCH", f"/uploads/{file_id}", json=fields))

    async def delete_photo(self, file_id: Id, *, permanently: bool = False) -> answers.Deleted:
        """Delete a photo; unless `permanently`, it can be restored for REMOVED_PHOTO_DAYS.

        `photos(removed=True)` are those that can be.
        """
        params = {"permanently": permanently}
        return answers.Deleted(**await self._call("DELETE", f"/uploads/{file_id}", params=params))

    async def restore_photo(self, file_id: Id) -> answers.OnePhoto:
        """Restore a deleted photo."""
        return answers.OnePhoto(**await self._call("POST", f"/uploads/{file_id}/restore"))

    def propose_places(self, /, **options: Any) -> AsyncIterator[answers.PlaceProposal]:
        """Iterate over proposals for the map's photos without a place. Nothing is stored.

        Args:
            options: `track`, `radius_m`, `motion` and `together`, as for `propose_positions`.
        """
        return self._iterate(answers.PlaceProposal, "/places/proposals", "proposals", body=options)

    async def give_places(self, photos: Sequence[Json]) -> answers.GivenPlaces:
        """Give places to photos that have none; those that have one are skipped and named.

        Args:
            photos: At most 1,000: `file_id`, and `latitude` and `longitude`, or `place`; of a
                proposal also `heading`, `probability` and `reason`.
        """
        body = {"photos": list(photos)}
        return answers.GivenPlaces(**await self._call("POST", "/places", json=body))

    async def undo_places(self, file_ids: Sequence[Id] | None = None) -> answers.UndonePlaces:
        """Take back the places that were given to these photos; None: to all of the map."""
        body = {"file_ids": None if file_ids is None else [str(each) for each in file_ids]}
        return answers.UndonePlaces(**await self._call("POST", "/places/undo", json=body))

    async def fit_vocabulary(self, /, **options: int) -> answers.Started:
        """Start fitting a vocabulary on the map's photos.

        Options are `clusters`, `sample` and `seed`.
        """
        return answers.Started(**await self._call("POST", "/vocabularies", json=options))

    async def import_vocabulary(self, file: str | Path) -> answers.Started:
        """Start reindexing the map with a vocabulary from a `.npz` or `.npy` file."""
        return answers.Started(**await self._send_file("/vocabularies/import", file))

    async def vocabularies(self) -> list[answers.Vocabulary]:
        """List the map's vocabularies, newest first."""
        return [answers.Vocabulary(**item) for item in await self._call("GET", "/vocabularies")]

    async def vocabulary_file(self, vocabulary_id: Id) -> bytes:
        """Download a vocabulary file that `import_vocabulary` accepts.

        The format is `.npz` (starting with `PK`), or `.npy` if its provenance is unknown.
        """
        return await self._get_bytes(f"/vocabularies/{vocabulary_id}/file")

    async def start_generation(
        self,
        *,
        vocabulary_id: Id | None = None,
        pca: int | None = None,
        extractor: str | None = None,
    ) -> answers.Started:
        """Start a new generation of the map's descriptors.

        Without arguments, PCA is undone for an extractor without a vocabulary.

        Args:
            pca: Number of dimensions to reduce to by PCA whitening.
        """
        body = drop_none(
            vocabulary_id=vocabulary_id and str(vocabulary_id), pca=pca, extractor=extractor
        )
        return answers.Started(**await self._call("POST", "/generations", json=body))

    async def generations(self) -> list[answers.Generation]:
        """List the map's generations, newest first."""
        return [answers.Generation(**item) for item in await self._call("GET", "/generations")]

    async def export_descriptors(
        self,
        generation_id: Id,
        file: BinaryIO,
        on_received: Callable[[int], object] = lambda received_bytes: None,
    ) -> None:
        """Download a tar with `descriptors.npy`, `names.txt` and `photos.csv` into a file.

        Args:
            file: Seekable and writable; overwritten from its beginning.
            on_received: Called with the number of bytes received so far.
        """
        path = f"/generations/{generation_id}/descriptors"
        await self._download(path, file, on_received)

    async def reconstruct(self, *, from_scratch: bool = False) -> answers.Started:
        """Start reconstructing the map's photos, or registering new ones into its reconstruction.

        Args:
            from_scratch: Reconstruct all photos again.
        """
        return answers.Started(
            **await self._call("POST", "/reconstructions", json={"from_scratch": from_scratch})
        )

    async def import_reconstruction(self, model: Json) -> answers.Started:
        """Start using the cameras and poses of a COLMAP model for the map's photos.

        Args:
            model: `cameras` and `photos`, as `POST /reconstructions/import` describes them.
        """
        return answers.Started(**await self._call("POST", "/reconstructions/import", json=model))

    async def reconstruction(self) -> answers.Reconstruction:
        """Get the map's reconstruction.

        Raises:
            NotFound: `no_reconstruction`, with the reason.
        """
        return answers.Reconstruction(**await self._call("GET", "/reconstructions"))

    async def coordinate_proposals(self, reconstruction_id: Id) -> list[answers.CoordinateProposal]:
        """List the photos whose coordinates disagree with a reconstruction, largest distance first.

        Nothing is changed; `patch_photo` accepts one.
        """
        answer = await self._call("GET", f"/reconstructions/{reconstruction_id}/proposals")
        return [answers.CoordinateProposal(**each) for each in answer["proposals"]]

    async def export_colmap(
        self,
        reconstruction_id: Id,
        file: BinaryIO,
        on_received: Callable[[int], object] = lambda received_bytes: None,
    ) -> None:
        """Download a tar with the COLMAP model of each component into a file.

        Args:
            file: Seekable and writable; overwritten from its beginning.
            on_received: Called with the number of bytes received so far.
        """
        await self._download(f"/reconstructions/{reconstruction_id}/colmap", file, on_received)

    async def evaluate(self, /, **options: int) -> answers.Started:
        """Start an evaluation of the map; options are `sample` and `seed`."""
        return answers.Started(**await self._call("POST", "/evaluations", json=options))

    def evaluations(self) -> AsyncIterator[answers.Evaluation]:
        """Iterate over the map's evaluations, newest first."""
        return self._iterate(answers.Evaluation, "/evaluations", "evaluations")

    def searches(self) -> AsyncIterator[answers.Search]:
        """Iterate over the search history, newest first."""
        return self._iterate(answers.Search, "/searches", "searches")

    async def maps(self) -> list[answers.Map]:
        """List the maps of the server."""
        return [answers.Map(**item) for item in await self._call("GET", "/maps")]

    async def create_map(
        self,
        name: str,
        extractor: str | None = None,
        *,
        place_labels_are_paths: bool | None = None,
        rows: str | None = None,
        auto_fit: bool = True,
        matching: str | None = None,
        elsewhere: float | None = None,
    ) -> answers.Map:
        """Create a map; `extractor` and `rows` (float32 or float16) default to the settings.

        With `place_labels_are_paths`, `/` separates the levels of place labels, or not; by default,
        evaluations decide that by the labels. `matching` (auto, on or off) is whether local
        features of its photos are computed and matched, `elsewhere` the share of its queries that
        are from elsewhere (0.33).
        """
        body = drop_none(
            name=name,
            extractor=extractor,
            place_labels_are_paths=place_labels_are_paths,
            rows=rows,
            auto_fit=None if auto_fit else False,
            matching=matching,
            elsewhere=elsewhere,
        )
        return answers.Map(**await self._call("POST", "/maps", json=body))

    async def update_map(
        self,
        name: str,
        *,
        place_labels_are_paths: bool | Literal["auto"] | None = None,
        rows: str | None = None,
        auto_fit: bool | None = None,
        matching: str | None = None,
        elsewhere: float | None = None,
    ) -> answers.Map:
        """Change settings of a map; None leaves one unchanged.

        Args:
            place_labels_are_paths: Whether `/` separates the levels of place labels. With `auto`,
                the labels decide, now and at each evaluation.
            rows: float32 or float16, for generations that are created from then on.
            auto_fit: Whether vocabularies are fitted automatically.
            matching: auto, on or off. With on, a model change (`model_change_id`) computes local
                features that are missing.
            elsewhere: Share of its queries that are from elsewhere, where a request names none.
        """
        body = drop_none(
            place_labels_are_paths=place_labels_are_paths,
            rows=rows,
            auto_fit=auto_fit,
            matching=matching,
            elsewhere=elsewhere,
        )
        return answers.Map(**await self._call("PATCH", f"/maps/{quote(name, safe='')}", json=body))

    async def delete_map(self, name: str) -> answers.DeletedMap:
        """Delete a map and all its photos."""
        return answers.DeletedMap(**await self._call("DELETE", f"/maps/{quote(name, safe='')}"))

    async def stats(self) -> answers.Stats:
        """Get statistics of the map."""
        return answers.Stats(**await self._call("GET", "/database/stats"))

    async def add_model(
        self,
        checkpoint: str | Path | BinaryIO,
        name: str,
        *,
        options: str | None = None,
        licence: str | None = None,
        note: str | None = None,
        filename: str | None = None,
    ) -> answers.Started:
        """Start adding a checkpoint, TorchScript or ONNX file as an extractor.

        Args:
            checkpoint: The file: its path, or open for reading bytes.
            name: Permanent name; maps refer to it as `gsv:NAME`, `torchscript:NAME` or `onnx:NAME`.
            options: Of a TorchScript or ONNX file: `input.size=288x288,aggregator=vlad`.
            filename: Name of an open file; None for the name of the path.
        """
        fields = {"name": name, "options": options, "licence": licence, "note": note}
        return answers.Started(**await self._send_file("/models", checkpoint, filename, fields))

    async def models(self) -> list[answers.AddedModel]:
        """List the added models."""
        page = await self._call("GET", "/models")
        return [answers.AddedModel(**item) for item in page["models"]]

    async def remove_model(self, name: str) -> answers.RemovedModel:
        """Remove a model that no map uses."""
        path = f"/models/{quote(name, safe='')}"
        return answers.RemovedModel(**await self._call("DELETE", path))

    async def keys(self) -> list[answers.Key]:
        """List the API keys of the server, without their secrets (admin only)."""
        return [answers.Key(**item) for item in await self._call("GET", "/keys")]

    async def create_key(
        self, /, name: str, scopes: Sequence[str], **limits: Any
    ) -> answers.CreatedKey:
        """Create an API key (admin only). Its secret is shown only in this response.

        Args:
            name: Owner or purpose.
            scopes: `read`, `write`, `admin`.
            limits: The optional fields of `POST /keys`: `maps`, `days`, `requests_per_minute`,
                `max_photos`.
        """
        body = {"name": name, "scopes": list(scopes), **drop_none(**limits)}
        return answers.CreatedKey(**await self._call("POST", "/keys", json=body))

    async def revoke_key(self, key_id: Id) -> answers.Key:
        """Revoke an API key (admin only)."""
        return answers.Key(**await self._call("DELETE", f"/keys/{key_id}"))


def _job_id(work: Work) -> Id:
    if isinstance(work, (UUID, str)):
        return work
    if work.job_id is None:
        raise Unprocessable(
            "no_job", "This upload has no job: its photo has already been described."
        )
    return work.job_id
